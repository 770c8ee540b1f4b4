"""What is broken in a data set of nuScenes is named."""

import pytest
from nuscenes_fixture import VERSION, edit_table, token
from nuscenes_reading import change_front, read

from mdnvo_jax.data import nuscenes
from mdnvo_jax.errors import InputError


def spoil(field, value, count=1):
    """Return a change of a table that sets `field` of its first `count` rows."""

    def change(rows):
        for row in rows[:count]:
            row[field] = value

    return change


def lose(field):
    return lambda rows: [{name: value for name, value in row.items() if name != field} for row in rows]


def second_front(rows):
    """Add the row of one image again, with another time."""
    row = next(row for row in rows if "CAM_FRONT" in row["filename"])
    return [*rows, {**row, "timestamp": row["timestamp"] + 1}]


def same_time(rows):
    """Give two images one time."""
    first, second = [row for row in rows if "CAM_FRONT" in row["filename"]][:2]
    second["timestamp"] = first["timestamp"]


@pytest.mark.parametrize(
    ("table", "change", "message"),
    [
        ("sample_data", lose("ego_pose_token"), r"sample_data.json, line \d+: a row without ego_pose_token"),
        ("ego_pose", lose("rotation"), r"ego_pose.json, line \d+: a row without rotation"),
        ("scene", lambda rows: [1, *rows], r"scene.json, line 2: a row without token, name, description"),
        (
            "ego_pose",
            spoil("rotation", [1.0, 0.0, 0.0], 99),
            r"ego_pose.json, token \w{32}: expected a translation of 3",
        ),
        ("ego_pose", spoil("rotation", [2.0, 0.0, 0.0, 0.0], 99), "expected metres, a unit quaternion"),
        ("ego_pose", spoil("translation", [float("nan"), 0.0, 0.0], 99), "expected metres, a unit quaternion"),
        ("ego_pose", spoil("translation", None, 99), "expected a translation of 3 numbers"),
        ("ego_pose", spoil("timestamp", "noon", 99), "timestamp noon: expected microseconds"),
        ("ego_pose", lambda rows: rows + [{**row, "translation": [0, 0, 0]} for row in rows], "two rows that differ"),
        ("ego_pose", lambda rows: [], "24 of 24 frames have no row in ego_pose.json"),
        ("sample_data", second_front, r"sample_data.json, token \w{32}: two rows that differ"),
        ("sample_data", same_time, "have the same timestamp"),
        ("sample_data", change_front(sample_token="x"), r"no sample x"),
        ("sample_data", change_front(timestamp=None), "expected timestamp, height and width"),
        ("sample_data", spoil("calibrated_sensor_token", "x"), "no calibrated_sensor x"),
        ("sample_data", lambda rows: [], "scene-0061 has no frame of CAM_FRONT"),
        ("calibrated_sensor", change_front(camera_intrinsic=[]), "expected the 3x3 matrix of a camera"),
        ("calibrated_sensor", change_front(camera_intrinsic=[[0, 0, 1]] * 3), "expected the 3x3 matrix of a camera"),
        ("calibrated_sensor", lambda rows: rows + [{**r, "translation": [0, 0, 0]} for r in rows], "rows that differ"),
        ("calibrated_sensor", lambda rows: [], "calibrated_sensor.json has no row of a sensor CAM_FRONT"),
        ("sensor", spoil("channel", "CAM_NORTH", 9), "found sensors CAM_NORTH"),
        ("scene", lambda rows: [*rows, {**rows[0], "token": "other"}], "two scenes scene-0061"),
        ("scene", lambda rows: {"scene-0061": rows}, r"scene.json does not begin with \["),
    ],
)
def test_malformed_tables_are_named(one, table, change, message):
    root, _ = one
    edit_table(root, table, change)
    with pytest.raises(InputError, match=message):
        read(root)


def test_two_cameras_in_one_scene_are_refused(one):
    root, _ = one
    other = token("calibrated", "n001", "CAM_FRONT")
    edit_table(root, "sample_data", change_front(calibrated_sensor_token=other))
    with pytest.raises(InputError, match="2 intrinsics of CAM_FRONT"):
        read(root)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"does not begin with \["),
        ("[", "line 1: the file ends too early"),
        ('[\n{"token": "a", "name": "b", "descr', r"line 2: .*expected a table of nuScenes"),
        ('[\n{"token": "a", "name": "b", "description": ""},\n', "line 3: the file ends too early"),
        ('[\n{"token": "a", "name": "b", "description": ""},\n{token: 2}]', r"line 3: Expecting property name"),
        (b"[\xff]", "cannot read"),
    ],
)
def test_broken_json_is_named(one, text, message):
    root, _ = one
    (root / VERSION / "scene.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=message):
        read(root)


def test_missing_tables_are_named(one):
    root, _ = one
    (root / VERSION / "sensor.json").unlink()
    (root / VERSION / "ego_pose.json").unlink()
    with pytest.raises(InputError, match=r"has no sensor.json, ego_pose.json: expected the metadata"):
        read(root)
    with pytest.raises(InputError, match=r"no folder v1.0-mini in .*found no v1.0-\* folder"):
        nuscenes.scenes(root / VERSION, VERSION)


def test_bad_images_are_named_when_they_are_read(mini, one):
    root, _ = mini
    sequence = read(root, "scene-0103")
    assert nuscenes.missing_images(sequence) == [sequence.paths[3]]
    sequence.read(2)
    with pytest.raises(InputError, match=r"cannot read .*sweeps/CAM_FRONT/n001-.*\.jpg"):
        sequence.read(3)
    root, _ = one
    edit_table(root, "sample_data", change_front(width=1600, height=900))
    sequence = read(root)
    with pytest.raises(InputError, match=r"is 64x36 but the tables say 1600x900"):
        [sequence.read(index) for index in range(24)]
