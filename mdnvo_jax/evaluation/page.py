"""A page that holds all of one evaluation: tables and pictures in one file, nothing from elsewhere, no script."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from mdnvo_jax.evaluation import tables
from mdnvo_jax.evaluation.tables import Table

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.45 system-ui, "Liberation Sans", Arial, sans-serif; color: #1a1a1a; background: #fff;
  max-width: 1360px; margin: 0 auto; padding: 1.5rem 2rem 4rem; }
h1 { font-size: 1.6rem; margin: 0 0 .6rem; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; padding-bottom: .25rem; border-bottom: 2px solid #0072b2; }
h3 { font-size: 1.02rem; margin: 1.5rem 0 .4rem; }
p, ul { margin: .35rem 0; max-width: 75rem; }
ul { color: #444; font-size: .87rem; padding-left: 1.2rem; }
code { font: .85rem/1.4 "Liberation Mono", Consolas, monospace; overflow-wrap: anywhere; }
.wide { overflow-x: auto; margin: .5rem 0; }
table { border-collapse: collapse; font-size: .84rem; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .6rem; vertical-align: top; }
th { background: #eef3f7; font-weight: 600; vertical-align: bottom; }
th.over { text-align: center; border-left: 2px solid #fff; border-right: 2px solid #fff; }
th.text, td.text { text-align: left; }
th.number, td.number { text-align: right; }
td.number { white-space: nowrap; }
tbody tr { border-bottom: 1px solid #d8dee4; }
tbody tr:nth-child(even) { background: #fafbfc; }
.interval { display: block; color: #5a5a5a; font-size: .78rem; }
figure { margin: 1.2rem 0; }
figcaption { color: #444; font-size: .87rem; margin-top: .2rem; }
img { max-width: 100%; height: auto; border: 1px solid #d8dee4; }
@media print { body { max-width: none; padding: 0; } figure, tr { break-inside: avoid; } }
"""


@dataclass(frozen=True)
class Picture:
    """A PNG file to embed, and what it shows."""

    path: Path
    caption: str


def as_page(
    title: str, about: Mapping[str, str], shown: Sequence[Table], details: Sequence[Table], pictures: Sequence[Picture]
) -> str:
    """Return a whole page of HTML.

    Args:
      title: of the page.
      about: what was run and with what, by name.
      shown: tables that come first.
      details: tables that come after the pictures.
      pictures: in the order of showing.
    """
    lines = [
        "<!DOCTYPE html>",
        '<html lang="en">',
        "<head>",
        '<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>",
        f"<style>{_STYLE}</style>",
        "</head>",
        "<body>",
        f"<h1>{escape(title)}</h1>",
        *(f"<p>{escape(name)}: <code>{escape(text)}</code></p>" for name, text in about.items()),
        "<h2>Results</h2>",
        *(tables.as_html(table) for table in shown),
    ]
    if pictures:
        lines += ["<h2>Pictures</h2>", *(_figure(picture) for picture in pictures)]
    if details:
        lines += ["<h2>Details</h2>", *(tables.as_html(table) for table in details)]
    return "\n".join([*lines, "</body>", "</html>", ""])


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.path.read_bytes()).decode("ascii")
    caption = escape(picture.caption)
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{caption}">'
        f"<figcaption>{caption} ({escape(picture.path.name)})</figcaption></figure>"
    )
