"""How rows are read from the tables of nuScenes: in chunks, no further than needed, and once."""

import json

import pytest
from nuscenes_fixture import VERSION, edit_table
from nuscenes_reading import read

from mdnvo_jax.data import nuscenes, nuscenes_tables
from mdnvo_jax.errors import InputError


@pytest.mark.parametrize("chunk", [1, 2, 7, 100, 4096])
@pytest.mark.parametrize("indent", [None, 0, 2])
def test_rows_are_read_whatever_the_chunk(tmp_path, monkeypatch, chunk, indent):
    expected = [{"token": f"é{i} [{{", "rotation": [i, {"x": -1.5e-3}], "more": None} for i in range(20)]
    (tmp_path / "t.json").write_text(json.dumps(expected, indent=indent), encoding="utf-8")
    monkeypatch.setattr(nuscenes_tables, "_CHUNK", chunk)
    found = list(nuscenes_tables.rows(tmp_path / "t.json", ("token", "rotation")))
    assert found == [(row["token"], row["rotation"]) for row in expected]


@pytest.mark.parametrize("chunk", [1, 10, 60, 4096])
def test_the_line_is_right_whatever_the_chunk(tmp_path, monkeypatch, chunk):
    good = '{"token": "a",\n "name": "b"},\n'
    monkeypatch.setattr(nuscenes_tables, "_CHUNK", chunk)
    for bad, message in (('{"token": x}', "Expecting value"), ('{"token": "c"}', "a row without name")):
        (tmp_path / "t.json").write_text("[\n" + 10 * good + bad + "]")
        with pytest.raises(InputError, match=rf"t.json, line 22: {message}"):
            list(nuscenes_tables.rows(tmp_path / "t.json", ("token", "name")))


def test_a_broken_row_does_not_make_it_read_the_whole_table(tmp_path, monkeypatch):
    monkeypatch.setattr(nuscenes_tables, "_CHUNK", 1 << 16)
    (tmp_path / "t.json").write_text("[{]" + " " * (1 << 20))
    reads = []
    more = nuscenes_tables._more
    monkeypatch.setattr(nuscenes_tables, "_more", lambda file, path: reads.append(1) or more(file, path))
    with pytest.raises(InputError, match="line 1: Expecting property name"):
        list(nuscenes_tables.rows(tmp_path / "t.json", ("a", "b")))
    assert len(reads) <= 3


def test_tables_are_read_once_until_they_change(one, monkeypatch):
    root, _ = one
    before = read(root)
    monkeypatch.setattr(nuscenes_tables, "rows", lambda *_: pytest.fail("read again"))
    assert read(root).count == before.count and nuscenes.scenes(root, VERSION)[0].frames == 24
    monkeypatch.undo()
    edit_table(root, "scene", lambda rows: [{**row, "description": "Night"} for row in rows])
    assert nuscenes.scenes(root, VERSION)[0].condition == "night"
