"""Reading the small data set of nuscenes_fixture, and rows of it changed; no test itself."""

import numpy as np
from nuscenes_fixture import VERSION, Spec, token

from mdnvo_jax.data.nuscenes import read_nuscenes

ONE = (Spec("scene-0061", "Parked lorry"),)


def read(root, scene="scene-0061", **options):
    return read_nuscenes(root, scene, version=VERSION, **options)


def rebased(poses):
    return np.linalg.inv(poses[0]) @ poses


def change_front(**values):
    """Return a change of sample_data or calibrated_sensor that sets values in the first row of the front camera."""

    def change(rows):
        front = {token("calibrated", f"n00{number}", "CAM_FRONT") for number in (0, 1)}
        row = next(row for row in rows if row.get("calibrated_sensor_token", row["token"]) in front)
        row.update(values)

    return change
