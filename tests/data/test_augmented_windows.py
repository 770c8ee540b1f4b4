"""What augmentation makes of windows: frames, labels and optical flow follow each other."""

import dataclasses

import numpy as np
import pytest
from toy_windows import IMAGE, config_of, matrices, numbers, taken

from mdnvo_jax.config import ImageConfig, ModelConfig
from mdnvo_jax.data import augment, windows
from mdnvo_jax.data.sequence import Sequence

FOCAL, CENTRE = 60.0, (44.0, 16.0)
SIZE = (32, 96)
LANDMARKS = np.array([[-3.0, 0.4, 11.0], [1.0, -0.6, 12.0], [4.0, 0.8, 14.0]])


def landmark_drive():
    """Return a sequence whose frames show three far points as smooth blobs, with cx off the middle of the frame."""
    rng = np.random.default_rng(4)
    poses = [np.eye(4)]
    for _ in range(7):
        poses.append(poses[-1] @ matrices(rng.normal((0, 0, 0.25, 0, 0.02, 0), 0.01, 6)[None])[0])
    poses = np.stack(poses)

    def read(index):
        points = (LANDMARKS - poses[index, :3, 3]) @ poses[index, :3, :3]
        u, v = projected(points)
        rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
        light = sum(np.exp(-((columns - a) ** 2 + (rows - b) ** 2) / 8) for a, b in zip(u, v, strict=True))
        frame = np.rint(250 * light).clip(0, 255).astype(np.uint8)[..., None]
        frame[0, round(CENTRE[0])] = 10 * index  # stays in its place when mirrored
        return frame

    return Sequence("points", 8, read, poses=poses, camera=(FOCAL, FOCAL, *CENTRE))


def projected(points):
    return FOCAL * points[:, 0] / points[:, 2] + CENTRE[0], FOCAL * points[:, 1] / points[:, 2] + CENTRE[1]


def located(frame, at):
    """Return the centre of the light within 5 pixels of `at`."""
    u, v = (round(x) for x in at)
    rows, columns = np.mgrid[v - 5 : v + 6, u - 5 : u + 6]
    light = frame[v - 5 : v + 6, u - 5 : u + 6, 0].astype(float)
    return (columns * light).sum() / light.sum(), (rows * light).sum() / light.sum()


@pytest.mark.parametrize("mirror", [0.0, 1.0])
@pytest.mark.parametrize("reverse", [0.0, 1.0])
@pytest.mark.parametrize("stride", [1, 2])
def test_augmented_labels_say_where_points_go_in_the_augmented_frames(mirror, reverse, stride):
    """The label, applied to points seen in one frame, tells where the next frame shows them."""
    image = ImageConfig(height=SIZE[0], width=SIZE[1], channels=1, camera=(FOCAL, FOCAL, *CENTRE))
    config = config_of(1, image, window=3, mirror=mirror, reverse=reverse, strides=(stride,))
    sequence = landmark_drive()
    worst = 0.0
    for batch in taken(windows.training_batches([sequence], config, seed=1), 5):
        frames, steps = batch["images"][0], batch["steps"][0].astype(float)
        index = frames[0][0, round(CENTRE[0]), 0] // 10
        points = (LANDMARKS - sequence.poses[index, :3, 3]) @ sequence.poses[index, :3, :3]
        points[:, 0] *= 1 - 2 * mirror
        for frame, T in zip(frames[1:], matrices(steps), strict=True):
            points = (points - T[:3, 3]) @ T[:3, :3]
            at = np.array([located(frame, xy) for xy in zip(*projected(points), strict=True)])
            worst = max(worst, np.abs(at - np.stack(projected(points), -1)).max())
    assert worst < 0.1


def test_mirroring_is_drawn_for_half_of_the_windows(toy):
    config = config_of(batch_size=8, window=1, mirror=0.5, hop=1)
    sequence = toy(201)
    labels = sequence.steps()
    mirrored = 0
    for batch in taken(windows.training_batches([sequence], config, seed=5), 25):
        for frames, step in zip(numbers(batch), batch["steps"], strict=True):
            mirrored += not np.allclose(labels[frames[0]], step[0], atol=1e-6)
    assert 70 < mirrored < 130


# Optical flow


def test_batches_carry_flow_where_the_model_asks_for_it(toy):
    """Flow is known forwards at stride 1 alone; padding, other strides and windows played backwards have NaN."""
    flow = np.random.default_rng(0).normal(size=(40, 1, 2, 2)).astype(np.float32)
    sequence = dataclasses.replace(toy(40), flow=lambda index: flow[index], camera=(9.0, 9.0, 4.0, 4.0))
    image = dataclasses.replace(IMAGE, camera=(9.0, 9.0, 4.0, 4.0))
    config = config_of(image=image, window=4, shortest_window=2, strides=(1, 2), reverse=0.3)
    config = dataclasses.replace(config, model=ModelConfig(flow_weight=1.0))
    forwards = backwards = 0
    for batch in taken(windows.training_batches([sequence, toy(40)], config, seed=0), 12):
        assert batch["flow"].shape == (4, 4, 1, 2, 2) and batch["flow"].dtype == np.float32
        assert np.isnan(batch["flow"][~batch["mask"]]).all()
        for row, frames in enumerate(numbers(batch)):
            steps = int(batch["mask"][row].sum())
            found = batch["flow"][row, :steps]
            if np.isfinite(found).all():
                np.testing.assert_array_equal(found, flow[frames[:steps]])
                forwards += 1
            else:
                assert np.isnan(found).all()
                backwards += frames[0] > frames[1]
    assert forwards > 5 and backwards > 5
    plain = config_of(image=image, window=4)
    assert "flow" not in taken(windows.training_batches([sequence], plain, seed=0), 1)[0]


def test_mirrored_windows_have_mirrored_flow_and_narrow_ones_keep_it(toy):
    camera = (9.0, 9.0, 4.0, 4.0)
    flow = np.random.default_rng(0).normal(size=(40, 1, 2, 2)).astype(np.float32)
    sequence = dataclasses.replace(toy(40), flow=lambda index: flow[index], camera=camera)
    config = config_of(image=dataclasses.replace(IMAGE, camera=camera), window=4, mirror=1.0, narrow=1.0)
    config = dataclasses.replace(config, model=ModelConfig(flow_weight=1.0))
    batch = taken(windows.training_batches([sequence], config, seed=0), 1)[0]
    for row, frames in enumerate(numbers(batch)):
        np.testing.assert_array_equal(batch["flow"][row], augment.mirror_flow(flow[frames[:-1]], camera))


def test_as_many_windows_as_asked_for_are_overexposed_and_keep_their_labels(toy):
    pixels = np.random.default_rng(0).integers(0, 256, (40, 8, 16, 1), dtype=np.uint8)
    sequence = dataclasses.replace(toy(40), read=lambda i: pixels[i])
    config = config_of(image=IMAGE, batch_size=30, window=4, overexposed=0.5)
    plain = dataclasses.replace(config, data=dataclasses.replace(config.data, overexposed=0.0))
    batch, before = (taken(windows.training_batches([sequence], c, seed=0), 1)[0] for c in (config, plain))
    np.testing.assert_array_equal(batch["steps"], before["steps"])
    assert (batch["images"] >= before["images"]).all()
    brighter = (batch["images"] > before["images"]).any(axis=(1, 2, 3, 4))
    assert 8 <= brighter.sum() <= 22
    assert ((batch["images"] == 255).mean(axis=(1, 2, 3, 4)) > 0.02)[brighter].sum() > 5


def test_swaying_windows_have_swaying_frames_labels_and_flow(toy):
    camera = (9.0, 9.0, 7.5, 3.5)
    pixels = np.random.default_rng(0).integers(0, 256, (40, 8, 16, 1), dtype=np.uint8)
    flow = np.random.default_rng(1).normal(size=(40, 1, 2, 2)).astype(np.float32)
    sequence = dataclasses.replace(toy(40), read=lambda i: pixels[i], flow=lambda i: flow[i], camera=camera)
    config = config_of(image=dataclasses.replace(IMAGE, camera=camera), batch_size=20, window=4, sway=0.5)
    config = dataclasses.replace(config, model=ModelConfig(flow_weight=1.0))
    # Without sway the same windows come in the same order.
    still = dataclasses.replace(config, data=dataclasses.replace(config.data, sway=0.0))
    batch, plain = (taken(windows.training_batches([sequence], c, seed=0), 1)[0] for c in (config, still))
    swayed = [(a != b).any() for a, b in zip(batch["images"], plain["images"], strict=True)]
    assert 4 <= sum(swayed) <= 16
    for row, changed in enumerate(swayed):
        assert (batch["steps"][row] != plain["steps"][row]).all() == changed
        # Translation is turned with the camera: its length stays.
        length, before = (np.linalg.norm(b["steps"][row, :, :3], axis=1) for b in (batch, plain))
        np.testing.assert_allclose(length, before, rtol=1e-5)
        if not changed:
            np.testing.assert_array_equal(batch["flow"][row], plain["flow"][row])
    # Without intrinsics nobody can say what a turned camera sees.
    unknown = taken(windows.training_batches([dataclasses.replace(sequence, camera=None)], config, seed=0), 1)[0]
    np.testing.assert_array_equal(unknown["steps"], plain["steps"])


def test_a_window_that_stands_sways_and_does_not_pan(toy):
    camera = (9.0, 9.0, 7.5, 3.5)
    config = config_of(image=dataclasses.replace(IMAGE, camera=camera), batch_size=100, window=8, sway=1.0)

    def trend_deg(speed_m):
        poses = np.tile(np.eye(4), (200, 1, 1))
        poses[:, 2, 3] = speed_m * np.arange(200)
        sequence = toy(200, poses=poses, camera=camera)
        steps = taken(windows.training_batches([sequence], config, seed=0), 1)[0]["steps"][..., 3:]
        assert (np.abs(steps).max((0, 1)) > 1e-3).all()
        return np.rad2deg(steps.mean(1).std(0))

    assert (trend_deg(0.0) < 0.09).all()
    assert (trend_deg(0.5) > (0.08, 0.6, 0.12)).all()
