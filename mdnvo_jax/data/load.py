"""From a configuration to sequences: the one place that knows every data set."""

from collections.abc import Sequence as Many
from pathlib import Path

from mdnvo_jax.config import Config, ImageConfig
from mdnvo_jax.data import cache, kitti, windows
from mdnvo_jax.data.sequence import Sequence
from mdnvo_jax.errors import InputError

# Seeds of the synthetic worlds: those of training count from 0, the others from numbers no training reaches.
VALIDATION_SEED = 1_000_000
TEST_SEED = 2_000_000


def load_split(config: Config) -> tuple[list[Sequence], list[Sequence], ImageConfig]:
    """Return (training sequences, validation sequences, image configuration with its virtual camera resolved).

    Data set "kitti": the sequences named, from `data.cache` where given, else decoded from `data.root`. Validation is
    `data.validation_sequences`, or else the tail of every training sequence. Data set "synthetic": worlds of the seeds
    0, 1, ... for training and `VALIDATION_SEED`, ... for validation, rendered when read (`TEST_SEED`, ... are kept for
    tests of the result).

    Raises:
      InputError: a sequence is missing or malformed, or training and validation share one.
    """
    data = config.data
    if data.dataset == "synthetic":
        if min(data.worlds, data.validation_worlds) < 1 or data.worlds > VALIDATION_SEED:
            raise InputError(
                f"data.worlds {data.worlds} and data.validation_worlds {data.validation_worlds}: expected 1 or more"
            )
        train = synthetic_sequences(range(data.worlds), config)
        validation = synthetic_sequences(range(VALIDATION_SEED, VALIDATION_SEED + data.validation_worlds), config)
    else:
        if not data.train_sequences:
            raise InputError("data.train_sequences is empty: name sequences of the data set, such as 00 01 02")
        train = kitti_sequences(data.train_sequences, config)
        if data.validation_sequences:
            shared = set(data.train_sequences) & set(data.validation_sequences)
            if shared:
                raise InputError(
                    f"sequences {', '.join(sorted(shared))} are for training and validation: take them out of one list"
                )
            validation = kitti_sequences(data.validation_sequences, config)
        else:
            train, validation = windows.split(train, data)
    return train, validation, windows.resolve_camera(train, config.image)


def kitti_sequences(names: Many[str], config: Config, *, require_poses: bool = True) -> list[Sequence]:
    """Return the KITTI sequences of these names, from the cache where the configuration names one.

    A name that leads to a raw drive under `data.root` (2011_09_26/2011_09_26_drive_0001_sync) is read as such.

    Raises:
      InputError: neither root nor cache is given, or a sequence is missing or malformed.
    """
    data = config.data
    if len(set(names)) < len(names):
        raise InputError(f"sequences {' '.join(names)}: expected each name once")
    if data.cache:
        return cache.read_cache(data.cache, config.image, names)
    if not data.root:
        raise InputError("data.root is empty: set it to the folder that holds KITTI's sequences/ and poses/")
    sequences = []
    for name in names:
        if (Path(data.root) / name / "oxts").is_dir():
            folder = f"image_{kitti.camera_number(data.camera_folder, 'image_2'):02d}"
            sequence = kitti.read_kitti_raw(data.root, name, camera_folder=folder, channels=config.image.channels)
        else:
            sequence = kitti.read_kitti(
                data.root,
                name,
                camera_folder=data.camera_folder,
                channels=config.image.channels,
                require_poses=require_poses,
            )
        sequences.append(sequence)
    return sequences


def synthetic_sequences(seeds: Many[int], config: Config) -> list[Sequence]:
    """Return a rendered drive for each seed, of `data.world_frames` frames at the network's size.

    Frames are rendered for the virtual camera where there is one, so that nothing is left to rectify.
    """
    from mdnvo_jax.data import synthetic

    image = config.image
    camera = None
    if image.camera and image.rectify:
        fx, fy, cx, cy = image.camera
        camera = fx, fy, cx, cy
    return [
        synthetic.drive(
            seed,
            config.data.world_frames,
            height=image.height,
            width=image.width,
            channels=image.channels,
            camera=camera,
        )
        for seed in seeds
    ]
