"""Windows of frames with their labels: how they are cut, drawn, augmented, batched."""

import dataclasses
import itertools
from collections.abc import Iterator
from collections.abc import Sequence as Many
from typing import Any, NamedTuple

import grain
import numpy as np

from mdnvo_jax import geometry
from mdnvo_jax.config import Config, DataConfig, ImageConfig
from mdnvo_jax.data import augment, images, overlay
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError
from mdnvo_jax.model.network import flow_size

# Least standard deviation of a label (m, then rad): dividing by less would blow up a dimension that hardly varies.
STD_FLOOR = np.array([1e-3] * 3 + [1e-4] * 3)
# A window stands whose camera moves by less from each frame to the next: 0.4 m/s at ten frames a second.
_STANDS_M = 0.04
# Batches that are read ahead for each thread.
_AHEAD_PER_THREAD = 2


class Window(NamedTuple):
    """A run of `steps` steps over the frames start, start + stride, ... of a sequence."""

    sequence: int
    start: int
    stride: int
    steps: int


# The step of frame i to i + stride, `[N - stride, 6]`, by (number of the sequence, stride).
_Labels = dict[tuple[int, int], np.ndarray]


class _Example(NamedTuple):
    """A window as read: frames, one more than labels `[steps, 6]`, and where asked for flow `[steps, h, w, 2]`."""

    frames: Many[np.ndarray]
    labels: np.ndarray
    flow: np.ndarray | None = None


def resolve_camera(sequences: Many[Sequence], image_config: ImageConfig) -> ImageConfig:
    """Return `image_config` with its virtual camera filled in.

    Where it is empty and frames are rectified, it becomes the camera of the first of `sequences` that has one, scaled
    to the network's input; it stays empty where none has. That sequence's first frame is read for its size.
    """
    if image_config.camera or not image_config.rectify:
        return image_config
    for sequence in sequences:
        if sequence.camera is not None:
            size = sequence.read(0).shape[:2]
            camera = images.scaled_camera(sequence.camera, size, (image_config.height, image_config.width))
            return dataclasses.replace(image_config, camera=camera)
    return image_config


def split(sequences: Many[Sequence], data_config: DataConfig) -> tuple[list[Sequence], list[Sequence]]:
    """Return (training, validation): the tail of every sequence, `validation_tail` of its frames, is for validation.

    No frame is in both, and no step from the one to the other in either.

    Raises:
      InputError: the tail is not between 0 and 1, or leaves one of the two without a step.
    """
    tail = data_config.validation_tail
    if not 0 < tail < 1:
        raise InputError(f"data.validation_tail {tail}: expected a share of the frames, between 0 and 1")
    cuts = [sequence.count - max(2, round(tail * sequence.count)) for sequence in sequences]
    for sequence, cut in zip(sequences, cuts, strict=True):
        if cut < 2:
            raise InputError(
                f"sequence {sequence.name} has {sequence.count} frames: too few to set aside {tail:.0%} of them for "
                "validation; name data.validation_sequences, or give longer sequences"
            )
    train = [sequence.subsequence(0, cut) for sequence, cut in zip(sequences, cuts, strict=True)]
    validation = [sequence.subsequence(cut, sequence.count) for sequence, cut in zip(sequences, cuts, strict=True)]
    return train, validation


def training_windows(sequences: Many[Sequence], data_config: DataConfig) -> list[Window]:
    """Return every window that an epoch of training draws once.

    A window starts every `hop` frames, at every stride, where `window` steps fit. A sequence that is too short for
    one, but not for `shortest_window` steps, gives one shorter window.

    Raises:
      InputError: the configuration is contradictory, or a sequence gives no window at any stride.
    """
    steps, shortest = data_config.window, data_config.shortest_window or data_config.window
    if not (1 <= shortest <= steps and data_config.hop >= 1 and data_config.strides and min(data_config.strides) >= 1):
        raise InputError(
            f"data.window {steps}, shortest_window {data_config.shortest_window}, hop {data_config.hop}, strides "
            f"{data_config.strides}: expected 1 <= shortest_window <= window (or 0), hop >= 1 and strides of 1 or more"
        )
    windows: list[Window] = []
    for number, sequence in enumerate(sequences):
        before = len(windows)
        for stride in data_config.strides:
            longest = min(steps, (sequence.count - 1) // stride)
            if longest >= shortest:
                starts = range(0, sequence.count - longest * stride, data_config.hop)
                windows += [Window(number, start, stride, longest) for start in starts]
        if len(windows) == before:
            raise InputError(
                f"sequence {sequence.name} has {sequence.count} frames: too few for a window of {shortest} steps at "
                f"strides {data_config.strides}; lower data.window, or leave it out"
            )
    if not windows:
        raise InputError("no sequences to train on: name some in data.train_sequences")
    return windows


def validation_windows(sequences: Many[Sequence], data_config: DataConfig) -> list[Window]:
    """Return windows that hold every step of `sequences`, at the first of the strides, exactly once, in order.

    The last window of a sequence may be shorter.

    Raises:
      InputError: there is no step at all.
    """
    stride = data_config.strides[0]
    windows = []
    for number, sequence in enumerate(sequences):
        total = (sequence.count - 1) // stride
        for first in range(0, total, data_config.window):
            windows.append(Window(number, first * stride, stride, min(data_config.window, total - first)))
    if not windows:
        raise InputError("no sequence to validate on has a step: give longer ones in data.validation_sequences")
    return windows


def label_statistics(sequences: Many[Sequence], data_config: DataConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the labels that training sees, each `[6]` float64, m and rad.

    Every training window counts the same, with the lengths, strides, mirroring and reversal of `data_config` by their
    chances, exactly rather than by sampling; what a swaying camera adds is left out. The deviation is at least
    `STD_FLOOR`. For the mean step of the drives
    themselves (the constant predictor), give a `data_config` with `reverse` and `mirror` 0.

    Raises:
      InputError: a sequence has no poses, or there is no window.
    """
    windows = training_windows(sequences, data_config)
    labels, weights = [], []
    # Windows of one sequence and stride are of one length, and come one after the other.
    for (number, stride), group in itertools.groupby(windows, lambda window: (window.sequence, window.stride)):
        chosen = list(group)
        starts, longest = np.array([window.start for window in chosen]), chosen[0].steps
        labels.append(sequences[number].steps(stride))
        weights.append(np.zeros(len(labels[-1])))
        shortest = min(data_config.shortest_window or longest, longest)
        for step in range(longest):
            # Lengths from the shortest to the longest are equally likely: the chance that this step is drawn.
            chance = 1.0 if step < shortest else (longest - step) / (longest - shortest + 1)
            np.add.at(weights[-1], starts + step * stride, chance)
    label, weight = np.concatenate(labels), np.concatenate(weights)
    for chance, change in ((data_config.reverse, geometry.reverse_step), (data_config.mirror, geometry.mirror_step)):
        label = np.concatenate([label, change(label)])
        weight = np.concatenate([(1 - chance) * weight, chance * weight])
    mean = np.average(label, axis=0, weights=weight)
    std = np.sqrt(np.average((label - mean) ** 2, axis=0, weights=weight))
    return mean, np.maximum(std, STD_FLOOR)


def batches_per_epoch(sequences: Many[Sequence], config: Config) -> int:
    """Return how many whole batches one epoch of `training_batches` holds.

    Raises:
      InputError: there are fewer windows than one batch holds.
    """
    count = len(training_windows(sequences, config.data))
    if count < config.training.batch_size:
        raise InputError(
            f"{count} training windows do not fill a batch of {config.training.batch_size}: "
            "lower training.batch_size or data.hop, or give more sequences"
        )
    return count // config.training.batch_size


def training_batches(
    sequences: Many[Sequence], config: Config, *, seed: int, rank: int = 0, world: int = 1
) -> grain.DatasetIterator:
    """Return an endless iterator over batches of augmented training windows, in another order every epoch.

    A batch is a dict of images `[B, T+1, H, W, C]` uint8, steps `[B, T, 6]` float32 in m and rad, and mask `[B, T]`
    bool, False for padding (which repeats the last frame); with `model.flow_weight` also flow `[B, T, h, w, 2]`
    float32 on the map of `network.flow_size`, NaN where it is not known (also at strides above 1, backwards, in
    padding). The remainder of an epoch that fills no batch is dropped.
    What comes depends on `seed`, sequences and configuration only, whatever the number of threads; the iterator's
    `get_state()` is a small dict, from which `set_state` on a new iterator continues exactly.

    Args:
      sequences: with poses.
      config: image, data, and the batch size, which counts the windows of all processes together.
      seed: of order and augmentation, 0 to 2^32 - 1.
      rank: number of this process among `world`. Together the processes see the windows, augmentation included, that
        one process would see, in the same order: process r takes the r-th of `world` equal parts of a batch.
      world: number of processes.

    Raises:
      InputError: no poses, no window, or a batch size that `world` does not divide.
    """
    batch = _share(config, world)
    windows = training_windows(sequences, config.data)
    batches_per_epoch(sequences, config)
    labels = _label_tables(sequences, windows)
    backwards = {key: geometry.reverse_step(table) for key, table in labels.items()} if config.data.reverse else labels

    def draw(window: Window, rng: np.random.Generator) -> _Example:
        return _training_window(sequences, labels, backwards, window, config, rng)

    # Whole batches of all processes: else the processes' epochs would differ in length.
    whole = len(windows) // config.training.batch_size * config.training.batch_size
    drawn = grain.MapDataset.source(windows).seed(seed).shuffle()[:whole].random_map(draw)
    return _iterate(_rows_of(drawn, batch, rank, world), batch, config.data, endless=True)


def validation_batches(
    sequences: Many[Sequence], config: Config, *, rank: int = 0, world: int = 1
) -> Iterator[dict[str, np.ndarray]]:
    """Return batches that hold every validation step once, in order, not augmented.

    They are of the form that `training_batches` gives; the last one is filled up with windows whose mask is False
    throughout. With `world` processes, each sees its part of every batch, as `training_batches` says.

    Raises:
      InputError: no poses, no step, or a batch size that `world` does not divide.
    """
    batch = _share(config, world)
    windows = validation_windows(sequences, config.data)
    labels = _label_tables(sequences, windows)
    missing = -len(windows) % config.training.batch_size
    windows += [windows[-1]._replace(steps=0)] * missing

    def read(window: Window) -> _Example:
        indices = window.start + window.stride * np.arange(window.steps + 1)
        frames, _ = _frames(sequences[window.sequence], indices, config.image)
        return _Example(frames, labels[window.sequence, window.stride][indices[:-1]])

    return _iterate(_rows_of(grain.MapDataset.source(windows).map(read), batch, rank, world), batch, config.data)


def _training_window(
    sequences: Many[Sequence],
    labels_forwards: _Labels,
    labels_backwards: _Labels,
    window: Window,
    config: Config,
    rng: np.random.Generator,
) -> _Example:
    """Return one window as drawn by `rng`."""
    data, sequence = config.data, sequences[window.sequence]
    shortest = min(data.shortest_window or window.steps, window.steps)
    steps = int(rng.integers(shortest, window.steps + 1))
    reverse, mirror = rng.random() < data.reverse, rng.random() < data.mirror
    indices = window.start + window.stride * np.arange(steps + 1)
    labels = (labels_backwards if reverse else labels_forwards)[window.sequence, window.stride][indices[:-1]]
    if reverse:
        indices, labels = indices[::-1], labels[::-1]
    frames, cameras = _frames(sequence, indices, config.image)
    flow = None
    if config.model.flow_weight:
        flow = np.full((steps, *flow_size(config.image), 2), np.nan, np.float32)
        if sequence.flow is not None and window.stride == 1 and not reverse:
            flow = np.stack([sequence.flow(int(index)) for index in indices[:-1]])
    camera = cameras[0]
    if camera is not None and data.sway > 0 and rng.random() < data.sway:
        # Cars turn by driving: a camera that pans where nothing moves would only teach to doubt that it stands.
        stands = np.abs(labels[:, :3]).max() < _STANDS_M
        most_pan = 0.0 if stands else augment.most_pan(camera, frames[0].shape[1])
        rotations = augment.draw_sway(steps + 1, rng, most_pan_rad=most_pan)
        frames = list(augment.sway_frames(np.stack(frames), camera, rotations))
        labels = augment.sway_steps(labels, rotations)
        flow = None if flow is None else augment.sway_flow(flow, camera, rotations)
    if mirror:
        frames = [augment.mirror_frame(frame, own) for frame, own in zip(frames, cameras, strict=True)]
        labels = geometry.mirror_step(labels)
        flow = None if flow is None else augment.mirror_flow(flow, camera)
    if data.overlaid > 0 and rng.random() < data.overlaid:
        covered, cover = overlay.cover_frames(np.stack(frames), rng)
        frames = list(covered)
        flow = None if flow is None else overlay.cover_flow(flow, cover)
    if rng.random() < data.narrow:
        frames = list(augment.narrow(np.stack(frames), rng))
    if data.overexposed > 0 and rng.random() < data.overexposed:
        frames = list(augment.overexpose(np.stack(frames), rng))
    if data.photometric > 0:
        frames = list(augment.photometric(np.stack(frames), data.photometric, rng))
    return _Example(frames, labels, flow)


def _frames(
    sequence: Sequence, indices: np.ndarray, image_config: ImageConfig
) -> tuple[list[np.ndarray], list[tuple[float, float, float, float] | None]]:
    """Return the prepared frames at `indices` and their cameras."""
    decoded = [sequence.read(int(index)) for index in indices]
    frames = [images.prepare(frame, sequence.camera, image_config) for frame in decoded]
    cameras = [
        images.prepared_camera((frame.shape[0], frame.shape[1]), sequence.camera, image_config) for frame in decoded
    ]
    return frames, cameras


def _label_tables(sequences: Many[Sequence], windows: Many[Window]) -> _Labels:
    """Return the labels of every sequence that `windows` need, computed once rather than a window at a time."""
    return {(n, stride): sequences[n].steps(stride) for n, stride in {(w.sequence, w.stride) for w in windows}}


def _stacked(examples: Many[_Example], window: int) -> dict[str, np.ndarray]:
    """Return examples as one batch, shorter ones padded at their end; the last frame is repeated."""
    pixels = np.empty((len(examples), window + 1, *examples[0].frames[0].shape), np.uint8)
    steps = np.zeros((len(examples), window, 6), np.float32)
    mask = np.zeros((len(examples), window), bool)
    for row, example in enumerate(examples):
        count = len(example.labels)
        for column in range(window + 1):
            pixels[row, column] = example.frames[min(column, count)]
        steps[row, :count] = example.labels
        mask[row, :count] = True
    batch = {"images": pixels, "steps": steps, "mask": mask}
    if examples[0].flow is not None:
        batch["flow"] = np.full((len(examples), window, *examples[0].flow.shape[1:]), np.nan, np.float32)
        for row, example in enumerate(examples):
            batch["flow"][row, : len(example.labels)] = example.flow
    return batch


def _share(config: Config, world: int) -> int:
    """Return the windows of a batch that fall to each of `world` processes."""
    if config.training.batch_size < 1 or config.training.batch_size % world:
        raise InputError(
            f"training.batch_size {config.training.batch_size} is not divisible among {world} processes: "
            "expected a multiple of their number"
        )
    return config.training.batch_size // world


def _rows_of(examples: grain.MapDataset, batch: int, rank: int, world: int) -> grain.MapDataset:
    """Return the part of `examples` that process `rank` of `world` sees: `batch` rows in a run of each whole batch."""
    if world == 1:
        return examples
    # The mixture takes from its parts by turns: row after row of its batch.
    return grain.MapDataset.mix([examples[rank * batch + row :: world * batch] for row in range(batch)])


def _iterate(examples: Any, batch: int, data_config: DataConfig, *, endless: bool = False) -> grain.DatasetIterator:
    """Return an iterator over batches of `examples`, read ahead by threads."""
    threads = data_config.threads
    batches = examples.batch(batch, batch_fn=lambda chosen: _stacked(chosen, data_config.window))
    options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=_AHEAD_PER_THREAD * threads)
    return iter((batches.repeat() if endless else batches).to_iter_dataset(options))
