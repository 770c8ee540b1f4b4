"""Tables of nuScenes that are damaged or hostile."""

import contextlib
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hostile_files import damaged, in_one_line, quickly
from hypothesis import given
from hypothesis import strategies as st
from nuscenes_fixture import VERSION, Spec, write_nuscenes

from mdnvo_jax.data import nuscenes
from mdnvo_jax.errors import InputError


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("nuscenes")
    write_nuscenes(root, [Spec("scene-0001", "Rain", frames=4)])
    return root


@contextlib.contextmanager
def put_back(path: Path) -> Iterator[str]:
    """Give the text of a table, which the table has again in the end."""
    whole = path.read_text()
    try:
        yield whole
    finally:
        path.write_text(whole)


def deep(levels: int) -> str:
    return "[" * levels + "]" * levels


HOSTILE = (
    *('"../../../etc/passwd"', '"/etc/passwd"', '"\\u0000"', '"x"', "[]", "{}", "null", "true", "1e999", "-1", "NaN"),
    *("9" * 400, "9" * 5000, f"[{'9' * 400},0,0]", deep(3), deep(100_000)),
    *('[[1,0,0],[0,1,0],[0,0,"a"]]', "[1e308,1e308,1e308]"),
)
hostile_values = st.sampled_from(HOSTILE)


@pytest.mark.parametrize("name", ["sensor", "calibrated_sensor", "scene", "sample", "sample_data", "ego_pose"])
def test_any_table_is_read_or_refused(name: str, tables: Path) -> None:
    path = tables / VERSION / f"{name}.json"
    whole = path.read_text()
    rows = json.loads(whole)

    @quickly
    @given(st.data())
    def check(data: st.DataObject) -> None:
        if data.draw(st.booleans()):
            index = data.draw(st.integers(0, len(rows) - 1))
            field = data.draw(st.sampled_from(sorted(rows[index])))
            row = dict(rows[index]) | {field: "HERE"}
            text = json.dumps([*rows[:index], row, *rows[index + 1 :]]).replace('"HERE"', data.draw(hostile_values))
            path.write_text(text)
        else:
            path.write_bytes(data.draw(damaged(whole.encode())))
        for interpolate in (False, True):
            sequence = in_one_line(
                lambda interpolate=interpolate: nuscenes.read_nuscenes(
                    tables, "scene-0001", version=VERSION, interpolate=interpolate
                )
            )
            if sequence is not None:
                assert all(Path(name).resolve().is_relative_to(tables.resolve()) for name in sequence.paths)
                assert np.isfinite(sequence.poses).all()
        in_one_line(lambda: nuscenes.scenes(tables, VERSION))

    with put_back(path):
        check()


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("scene", lambda whole: "[]", r"scene\.json has no scene"),
        ("scene", lambda whole: "[]" + whole[1:], r"scene\.json, line 1: something comes after the last row"),
        (
            "sample_data",
            lambda whole: re.sub(r'("timestamp": )\d+', rf"\g<1>{'9' * 400}", whole),
            r"timestamp 9{40}: exp",
        ),
    ],
)
def test_tables_that_fuzzing_found(name: str, damage: Callable[[str], str], message: str, tables: Path) -> None:
    path = tables / VERSION / f"{name}.json"
    with put_back(path) as whole:
        path.write_text(damage(whole))
        with pytest.raises(InputError, match=message):
            nuscenes.read_nuscenes(tables, "scene-0001", version=VERSION)


@pytest.mark.parametrize("file", ["../outside.jpg", "samples/../../outside.jpg", "/etc/hostname"])
def test_a_name_in_a_table_does_not_lead_out_of_the_data_set(tables: Path, file: str) -> None:
    path = tables / VERSION / "sample_data.json"
    with put_back(path) as whole:
        rows = json.loads(whole)
        next(row for row in rows if "CAM_FRONT" in row["filename"])["filename"] = file
        path.write_text(json.dumps(rows))
        with pytest.raises(InputError, match=r"filename .*: expected a path below the data set's root"):
            nuscenes.read_nuscenes(tables, "scene-0001", version=VERSION)
