"""The page: complete, escaped, nothing from elsewhere, and readable in a real browser."""

import base64
import html.parser
import shutil
import subprocess

import cv2
import numpy as np
import pytest

from mdnvo_jax.evaluation.page import Picture, as_page
from mdnvo_jax.evaluation.tables import Column, Table, Value, as_html, as_markdown, as_text

VOID = {"meta", "img"}
# Their end may be left out.
OPEN = {"tr", "th", "td", "li", "p"}


class Reader(html.parser.HTMLParser):
    """Collects tags and text, and checks that tags close in order."""

    def __init__(self, text):
        super().__init__()
        self.stack, self.tags, self.texts = [], [], []
        self.feed(text)
        assert not [tag for tag in self.stack if tag not in OPEN]

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.stack.append(tag)

    def handle_endtag(self, tag):
        while self.stack[-1] != tag:
            assert self.stack.pop() in OPEN, tag
        self.stack.pop()

    def handle_data(self, data):
        if self.stack and self.stack[-1] != "style" and data.strip():
            self.texts.append(data.strip())


NASTY = '<script>alert("1")</script> & co'
TABLE = Table(
    f"Errors of {NASTY}",
    (Column("name", "estimate"), Column("split", "split"), Column("rmse", "RMSE <m>", 2, "low"), Column("n", "frames")),
    [
        {"name": NASTY, "split": "06", "rmse": Value(0.123, 0.1, 0.2), "n": "5 [of 9]"},
        {"name": "other", "split": "06", "rmse": Value(0.5, spread=0.1), "n": "9"},
    ],
    context=("split",),
    notes=["<i>a</i> < b"],
)
RIVALS = Table(
    "Table I",
    (
        Column("sequence", "sequence"),
        Column("a_rmse", "RMSE (m)", 2, "low", over="ORB-SLAM"),
        Column("a_max", "max (m)", 2, "low", over="ORB-SLAM"),
        Column("b_rmse", "RMSE (m)", 2, "low", over="MDN-VO"),
        Column("b_max", "max (m)", 2, "low", over="MDN-VO"),
    ),
    [
        {"sequence": "03", "a_rmse": Value(0.3), "a_max": Value(0.6), "b_rmse": Value(0.2), "b_max": Value(0.601)},
        {"sequence": "05", "b_rmse": Value(0.1), "b_max": Value(0.7)},
    ],
)


def picture(tmp_path):
    path = tmp_path / "red & green.png"
    cv2.imwrite(str(path), np.full((60, 90, 3), (0, 0, 255), np.uint8))
    return Picture(path, f"A picture of {NASTY}")


def test_a_table_says_what_it_says_as_text():
    reader = Reader(as_html(TABLE))
    for text in (f"Errors of {NASTY}", "Every row: split 06.", NASTY, "RMSE <m>", "0.12", "[0.10, 0.20]", "5 [of 9]"):
        assert text in "".join(reader.texts)
    assert "<i>a</i> < b" in reader.texts
    assert "split" not in [text for text in reader.texts if text != "Every row: split 06."]
    assert reader.texts[reader.texts.index("0.50 ± 0.10") - 2 :][:2] == ["5 [of 9]", "other"]
    # The best, and nothing else, is bold.
    assert as_html(TABLE).count("<b>") == 1 and "<b>0.12</b>" in as_html(TABLE)
    assert [tag for tag, _ in reader.tags].count("td") == 6


def test_columns_of_methods_compete_in_their_row():
    page = as_html(RIVALS)
    assert '<th class="over" colspan="2">ORB-SLAM</th><th class="over" colspan="2">MDN-VO</th>' in page
    # 0.60 and 0.601 print alike; in the second row there is nothing to be better than.
    assert page.count("<b>") == 3 and page.count("<b>0.20</b>") == 1 and page.count("<b>0.60</b>") == 2
    assert "| 03 | 0.30 | **0.60** | **0.20** | **0.60** |" in as_markdown(RIVALS)
    lines = as_text(RIVALS).splitlines()[2:]
    assert lines[0].split() == ["ORB-SLAM", "MDN-VO"]
    assert lines[1].split() == ["sequence", "RMSE", "(m)", "max", "(m)", "RMSE", "(m)", "max", "(m)"]
    assert lines[2].split() == ["03", "0.30", "0.60*", "0.20*", "0.60*"]
    # Each name stands over its own columns, and those stay together where the terminal is narrow.
    assert lines[1].index("max") < lines[0].index("MDN-VO") < lines[1].rindex("max")
    blocks = as_text(RIVALS, width=40).split("\n\n")[1:]
    assert [block.split()[0] for block in blocks] == ["ORB-SLAM", "MDN-VO"]
    assert blocks[1].splitlines()[2].split() == ["03", "0.20*", "0.60*"]


def test_the_page_holds_everything_and_asks_for_nothing(tmp_path):
    shown = picture(tmp_path)
    text = as_page(f"Title {NASTY}", {"Command": f"python {NASTY}"}, [TABLE], [RIVALS], [shown])
    reader = Reader(text)
    tags = [tag for tag, _ in reader.tags]
    assert not {"script", "link", "iframe"} & set(tags)
    sources = [attributes["src"] for _, attributes in reader.tags if "src" in attributes]
    assert [base64.b64decode(source.removeprefix("data:image/png;base64,")) for source in sources] == [
        shown.path.read_bytes()
    ]
    assert [attributes["alt"] for tag, attributes in reader.tags if tag == "img"] == [f"A picture of {NASTY}"]
    assert not any("href" in attributes for _, attributes in reader.tags)
    assert "url(" not in text and "@import" not in text and "http" not in text
    joined = "\n".join(reader.texts)
    order = [f"Title {NASTY}", f"python {NASTY}", f"Errors of {NASTY}", f"A picture of {NASTY}", "Table I"]
    assert [joined.index(part) for part in order] == sorted(joined.index(part) for part in order)
    assert "Pictures" not in Reader(as_page("t", {}, [TABLE], [], [])).texts


def test_a_browser_shows_it(tmp_path):
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium to look at the page with")
    page, screenshot = tmp_path / "report.html", tmp_path / "screenshot.png"
    page.write_text(as_page("Title", {}, [TABLE], [RIVALS], [picture(tmp_path)]), encoding="utf-8")
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={tmp_path / 'own'}")
    subprocess.run(
        [browser, *flags, "--window-size=900,1000", f"--screenshot={screenshot}", page.as_uri()],
        capture_output=True,
        check=True,
        timeout=60,
    )
    seen = cv2.imread(str(screenshot))
    assert seen.shape == (1000, 900, 3)
    # The picture is there in its size, text is there, and it is dark on white.
    red = (seen == (0, 0, 255)).all(axis=2)
    assert red.sum() == pytest.approx(60 * 90, rel=0.02)
    dark = (seen < 100).all(axis=2)
    assert 0.003 < dark.mean() < 0.2
    assert (seen == 255).all(axis=2).mean() > 0.6
