"""From a configuration to sequences: the one place that knows every data set."""

import sys
from collections import defaultdict
from collections.abc import Callable
from collections.abc import Sequence as Many
from pathlib import Path

from mdnvo_jax.config import Config, ImageConfig
from mdnvo_jax.data import cache, kitti, nuscenes, windows
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError

# Seeds of the synthetic worlds: those of training count from 0, the others from numbers no training reaches.
VALIDATION_SEED = 1_000_000
TEST_SEED = 2_000_000
# Rows and columns of frames that other lenses take: half of KITTI's.
_FILMED = (188, 620)


def load_split(config: Config) -> tuple[list[Sequence], list[Sequence], ImageConfig]:
    """Return (training sequences, validation sequences, image configuration with its virtual camera resolved).

    Data set "kitti": the sequences named, from `data.cache` where given, else decoded from `data.root`. Validation is
    `data.validation_sequences`, or else the tail of every training sequence. Data set "nuscenes": the scenes named, and
    for an empty list the split of `nuscenes`, of which scenes that cannot be used (too short, images not on disk) are
    left out with a line on stderr. Data set "synthetic": worlds of the seeds `data.first_world`, ... for training and
    `VALIDATION_SEED`, ... for validation, from the cache where given, else rendered when read (`TEST_SEED`, ... are
    kept for tests of the result).

    Raises:
      InputError: a sequence is missing or malformed, or training and validation share one.
    """
    data = config.data
    if data.dataset == "synthetic":
        if min(data.worlds, data.validation_worlds) < 1:
            raise InputError(
                f"data.worlds {data.worlds} and data.validation_worlds {data.validation_worlds}: expected 1 or more"
            )
        behind = data.first_world + data.worlds
        if data.first_world < 0 or behind > VALIDATION_SEED:
            raise InputError(
                f"data.first_world {data.first_world} and data.worlds {data.worlds}: expected seeds from 0 to "
                f"{VALIDATION_SEED - 1}, for later ones validate"
            )
        seeds = range(data.first_world, behind), range(VALIDATION_SEED, VALIDATION_SEED + data.validation_worlds)
        train, validation = (_worlds(part, config) for part in seeds)
    elif data.dataset == "nuscenes":
        train, validation = (
            nuscenes_sequences(names, config) if names else _nuscenes_part(part, config)
            for names, part in ((data.train_sequences, "train"), (data.validation_sequences, "validation"))
        )
        _check_disjoint([sequence.name for sequence in train], [sequence.name for sequence in validation])
    else:
        if not data.train_sequences:
            raise InputError("data.train_sequences is empty: name sequences of the data set, such as 00 01 02")
        train = kitti_sequences(data.train_sequences, config)
        if data.validation_sequences:
            _check_disjoint(data.train_sequences, data.validation_sequences)
            validation = kitti_sequences(data.validation_sequences, config)
        else:
            train, validation = windows.split(train, data)
    return train, validation, windows.resolve_camera(train, config.image)


def kitti_sequences(names: Many[str], config: Config) -> list[Sequence]:
    """Return the KITTI sequences of these names, from the cache where the configuration names one.

    A name that leads to a raw drive under `data.root` (2011_09_26/2011_09_26_drive_0001_sync) is read as such.

    Raises:
      InputError: neither root nor cache is given, or a sequence is missing or malformed.
    """
    data, channels = config.data, config.image.channels

    def read(name: str) -> Sequence:
        if (Path(data.root) / name / "oxts").is_dir():
            folder = f"image_{kitti.camera_number(data.camera_folder, 'image_2'):02d}"
            return kitti.read_kitti_raw(data.root, name, camera_folder=folder, channels=channels)
        return kitti.read_kitti(data.root, name, camera_folder=data.camera_folder, channels=channels)

    return _by_name(names, config, read, "that holds KITTI's sequences/ and poses/")


def nuscenes_sequences(names: Many[str], config: Config) -> list[Sequence]:
    """Return the scenes of nuScenes of these names, from the cache where the configuration names one.

    Raises:
      InputError: neither root nor cache is given, or a scene is missing or malformed.
    """
    data = config.data

    def read(name: str) -> Sequence:
        return nuscenes.read_nuscenes(
            data.root,
            name,
            version=data.version,
            channels=config.image.channels,
            key_frames_only=data.key_frames_only,
            interpolate=data.interpolate,
        )

    return _by_name(names, config, read, "of nuScenes, which holds samples/ and sweeps/")


def usable_scenes(config: Config, least: int, part: str = "") -> list[Sequence]:
    """Return the scenes of nuScenes that can be used; what is left out is said on stderr.

    Args:
      config: says where they are: in a cache or in the data set's own files.
      least: frames that a scene must have, beside every image of them.
      part: of the split of `nuscenes`; empty for all of it.

    Raises:
      InputError: see `nuscenes_sequences`.
    """
    data = config.data
    unusable: dict[str, list[str]] = defaultdict(list)
    if data.cache:
        found = [s for s in cache.read_cache(data.cache, config.image) if part in ("", nuscenes.split_of(s.name))]
    else:
        names: list[str] = []
        for scene in nuscenes.scenes(data.root, data.version) if data.root else ():
            if part in ("", scene.split):
                is_empty = not (scene.key_frames if data.key_frames_only else scene.frames)
                (unusable["without a frame"] if is_empty else names).append(scene.name)
        found = nuscenes_sequences(names, config)
    usable = []
    for sequence in found:
        if sequence.count < least:
            unusable[f"of fewer than {least} frames"].append(sequence.name)
        elif nuscenes.missing_images(sequence):
            unusable["with images that are not on disk"].append(sequence.name)
        else:
            usable.append(sequence)
    for line in nuscenes.left_out(unusable):
        _say(f"nuScenes{', ' * bool(part)}{part}: {line}")
    return usable


def _nuscenes_part(part: str, config: Config) -> list[Sequence]:
    """Return the scenes of one part of the split of nuScenes that can be used; see `usable_scenes`."""
    data = config.data
    if part == "train":
        least = 1 + (data.shortest_window or data.window) * min(data.strides, default=1)
    else:
        least = 1 + next(iter(data.strides), 1)
    usable = usable_scenes(config, least, part)
    if not usable:
        raise InputError(
            f"{data.cache or data.root} has no scene of nuScenes for {part} that can be used: name some in "
            f"data.{part}_sequences, or give another data.version"
        )
    longest_s = nuscenes.KEY_FRAME_GAP_S if data.key_frames_only else nuscenes.SWEEP_GAP_S
    gaps = [nuscenes.find_gaps(s.timestamps, longest_s) for s in usable if s.timestamps is not None]
    gaps = [found for found in gaps if found]
    if gaps:
        longest = max(gap.seconds for found in gaps for gap in found)
        _say(
            f"nuScenes, {part}: frames were dropped in {len(gaps)} of {len(usable)} scenes (gaps: "
            f"{sum(map(len, gaps))}, up to {longest:.2f} s); steps across gaps are longer, and their labels right"
        )
    return usable


def _worlds(seeds: Many[int], config: Config) -> list[Sequence]:
    """Return rendered drives from the cache where the configuration names one, else rendered when read."""
    from mdnvo_jax.data import synthetic

    if not config.data.cache:
        return synthetic_sequences(seeds, config)
    return cache.read_cache(config.data.cache, config.image, [synthetic.name_of(seed) for seed in seeds])


def synthetic_sequences(seeds: Many[int], config: Config, *, other_lenses: bool = False) -> list[Sequence]:
    """Return a rendered drive for each seed, of `data.world_frames` frames.

    Frames are rendered at the network's size for the virtual camera where there is one, so that nothing is left to
    rectify.

    Args:
      seeds: of the worlds.
      config: the experiment.
      other_lenses: render frames of `_FILMED` instead, each drive by a camera of its own, `synthetic.varied_camera`.
    """
    from mdnvo_jax.data import synthetic
    from mdnvo_jax.data.world.motion import CAMERA_HEIGHT_M

    image = config.image
    camera = None
    if image.camera and image.rectify:
        fx, fy, cx, cy = image.camera
        camera = fx, fy, cx, cy
    height, width = _FILMED if other_lenses else (image.height, image.width)
    height_m = config.data.camera_height_m or None
    drawn_m = CAMERA_HEIGHT_M
    if height_m is not None:
        low, high = config.data.camera_height_shares
        drawn_m = low * height_m, high * height_m
    return [
        synthetic.drive(
            seed,
            config.data.world_frames,
            height=height,
            width=width,
            channels=image.channels,
            camera=synthetic.varied_camera(seed, height, width) if other_lenses else camera,
            camera_height_m=drawn_m,
            scaled_to_height_m=height_m,
        )
        for seed in seeds
    ]


def _by_name(names: Many[str], config: Config, read: Callable[[str], Sequence], layout: str) -> list[Sequence]:
    """Return sequences from the cache where the configuration names one, else as `read` reads them from the root."""
    data = config.data
    if len(set(names)) < len(names):
        raise InputError(f"sequences {' '.join(names)}: expected each name once")
    if data.cache:
        return cache.read_cache(data.cache, config.image, names)
    if not data.root:
        raise InputError(f"data.root is empty: set it to the folder {layout}")
    return [read(name) for name in names]


def _check_disjoint(train: Many[str], validation: Many[str]) -> None:
    shared = set(train) & set(validation)
    if shared:
        raise InputError(
            f"sequences {', '.join(sorted(shared))} are for training and validation: take them out of one list"
        )


def _say(message: str) -> None:
    print(message, file=sys.stderr)
