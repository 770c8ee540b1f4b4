"""The configuration of an experiment: frozen dataclasses, loaded from a Python file, overridden on the command line.

A config file (see `configs/`) assigns a `Config` to the name `config`. Fields whose comment says "not given in the
paper" are ours to choose; the comment says why the default is what it is.
"""

import argparse
import dataclasses
import json
import runpy
import types
import typing
from pathlib import Path
from typing import Any, Literal

from mdnvo_jax.errors import InputError


@dataclasses.dataclass(frozen=True)
class ImageConfig:
    """How a decoded frame becomes the input of the network. Stored with the checkpoint: prediction repeats it."""

    # Rows and columns of the network's input. Not given in the paper; DeepVO code commonly uses 608x184 for KITTI.
    height: int = 184
    width: int = 608
    # 1 is grey, 3 is RGB.
    channels: int = 3
    # How uint8 becomes float. "standard": x / 255 - 0.5. "local_contrast": square root, minus a local Gaussian mean,
    # over a local deviation; makes rendered and real frames alike. "flownet": minus FlowNet's means, for its weights.
    normalisation: Literal["standard", "local_contrast", "flownet"] = "standard"
    # Intrinsics fx, fy, cx, cy of the virtual camera every frame is cropped and scaled to, in pixels of height x width,
    # pixel centres at whole numbers. Empty: training takes those of the first sequence that has any, scaled to fit.
    camera: tuple[float, ...] = ()
    # Whether frames with known intrinsics are brought to the virtual camera. Off: the whole frame is resized.
    rectify: bool = True


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The network: convolution stack, BiLSTM, head."""

    # Multiplies the channels 64..1024 of the paper's stack.
    width: float = 1.0
    # "float32", or "mixed": factors of the convolutions' products rounded to bfloat16, summed in float32, on GPU, TPU
    # and processors with AMX. Not given in the paper.
    products: Literal["float32", "mixed"] = "float32"
    # Type of the maps between the convolutions while training. "bfloat16" halves their memory; parameters, statistics,
    # the LSTM and the density stay float32. Not given in the paper.
    activations: Literal["float32", "bfloat16"] = "float32"
    # Compute the maps of the convolutions a second time in the backward pass instead of keeping them: less memory for
    # more time, on accelerators. On a processor it saves nothing (BENCHMARKS.md).
    rematerialise: bool = False
    # Paper: dropout 0.1 on the convolutions.
    conv_dropout: float = 0.1
    # Share of the running statistics of BatchNorm that a batch leaves. torch's default; with few windows a batch 0.99
    # is steadier.
    batch_norm_momentum: float = 0.9
    # Units a direction, and layers, of the LSTM. Not given in the paper; DeepVO has two layers of 1000.
    lstm_hidden: int = 1000
    lstm_layers: int = 2
    # Paper: 0.2 on the LSTM.
    lstm_dropout: float = 0.2
    # Paper: bidirectional. False gives a causal LSTM.
    bidirectional: bool = True
    # "mixture" is the paper's head, "regression" DeepVO's.
    head: Literal["mixture", "regression"] = "mixture"
    # Gaussians in the mixture. Not given in the paper.
    components: int = 3
    # Prediction looks at every pair of frames a second time, left and right exchanged, and gives the two densities in
    # equal parts (test-time augmentation): better, and less sure where the two disagree, for twice the work. Training,
    # and the losses it reports, are without it; for trainings that mirror windows (`data.mirror`). Not in the paper.
    mirrored: bool = False
    # "independent": equations 3 to 5, a product over dimensions. "joint": a mixture of diagonal Gaussians.
    coupling: Literal["independent", "joint"] = "independent"
    # Weight of an auxiliary loss on optical flow, which a 1x1 convolution reads off conv3_1 while training; for data
    # with exact flow, which rendered drives have. 0: no such layer. Not given in the paper, which starts from FlowNet.
    flow_weight: float = 0.0
    # Floors of the predicted standard deviation. Not given in the paper, whose density has none: without one a
    # dimension that never varies runs to a likelihood of infinity.
    translation_floor_m: float = 1e-3
    rotation_floor_rad: float = 1e-4


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """Which frames, cut into which windows, with which augmentation."""

    # "kitti": a folder in the layout of the odometry benchmark. "nuscenes": the front camera of nuScenes v1.0.
    # "synthetic": rendered while training.
    dataset: Literal["kitti", "nuscenes", "synthetic"] = "kitti"
    root: str = ""
    # Paper: left colour camera.
    camera_folder: str = "image_2"
    # Version of nuScenes: the folder of its tables in `root`, such as v1.0-mini.
    version: str = "v1.0-trainval"
    # nuScenes: two frames a second instead of about twelve.
    key_frames_only: bool = False
    # nuScenes: interpolate the ego poses of all sensors at the images' times; for tables that lack the images' own.
    interpolate: bool = False
    # Paper's training split of KITTI. Empty with nuScenes: the split of data/nuscenes.py, for the paper gives none.
    train_sequences: tuple[str, ...] = ("00", "01", "02", "04", "08", "09")
    # Sequences of the validation split. The paper names none; empty: the tail of every training sequence, and with
    # nuScenes the split of data/nuscenes.py.
    validation_sequences: tuple[str, ...] = ()
    validation_tail: float = 0.1
    # Folder made by bin/prepare_kitti; empty: decode while training.
    cache: str = ""
    # Steps in a window (frames - 1). Not given in the paper.
    window: int = 6
    # Shortest window drawn; 0 means always `window`.
    shortest_window: int = 0
    # Frames between the starts of two training windows.
    hop: int = 1
    # Strides over time that windows are drawn with; (1, 2) also trains on every second frame.
    strides: tuple[int, ...] = (1,)
    # Chances that a window is played backwards, or mirrored left-right, with its labels transformed exactly.
    reverse: float = 0.0
    mirror: float = 0.0
    # Strength of the photometric augmentation (gain, gamma, offset, noise); 0 turns it off.
    photometric: float = 0.0
    # Chance that a window is exposed for the shade: what the sun lights goes white.
    overexposed: float = 0.0
    # Chance that a window has in view what moves with the camera: the hood (bonnet) of its own car, or a caption.
    overlaid: float = 0.0
    # Chance that a window is shown as a camera with a narrower view would have it, the edge repeated outwards, as
    # bringing such a camera's frames to the virtual camera does.
    narrow: float = 0.0
    # Chance that the camera of a window sways on its mount and pans: each frame is turned by a rotation of its own, and
    # the labels with it. Needs the camera's intrinsics.
    sway: float = 0.0
    # Median time between two frames of the training sequences; 0: training takes it from them. Prediction says where
    # frames come at another rate.
    interval_s: float = 0.0
    # Threads that read and decode.
    threads: int = 2
    # Worlds and frames of the synthetic data set; validation worlds come on top and are disjoint by seed.
    worlds: int = 64
    # Seed of the first training world: further training on worlds that weights have not seen yet begins behind theirs.
    first_world: int = 0
    world_frames: int = 120
    validation_worlds: int = 8
    # Height of the camera above the road that the labels stand for, m; 0: not known, or not one. KITTI's is 1.65.
    # A single camera sees the ground plane up to scale, so prediction can rescale to the height of another camera.
    camera_height_m: float = 0.0
    # Shares of `camera_height_m` between which rendered worlds draw the height of their camera; the labels are then
    # scaled back to `camera_height_m`, so that they follow the ground and not the size of cars and houses.
    camera_height_shares: tuple[float, ...] = (0.94, 1.06)


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """Loss, optimiser, schedule and bookkeeping."""

    seed: int = 0
    batch_size: int = 8
    # Parts that a batch is taken in, one after another, to save memory: one step with the mean of their gradients.
    # BatchNorm normalises each part by itself. Slow on a processor (BENCHMARKS.md).
    accumulate: int = 1
    # Paper: about 40 epochs.
    epochs: int = 40
    # Epochs in a row without a better validation loss after which training ends; 0: it goes on to the last epoch.
    early_stop_patience: int = 0
    # Steps in an epoch; 0 means once through the training windows.
    steps_per_epoch: int = 0
    # "sgd": plain stochastic gradient descent, to compare with.
    optimiser: Literal["adam", "sgd"] = "adam"
    # Paper: Adam (0.9, 0.999), 1e-3, plateau with patience 8 and factor 0.7.
    learning_rate: float = 1e-3
    beta1: float = 0.9
    beta2: float = 0.999
    plateau_patience: int = 8
    plateau_factor: float = 0.7
    # Least absolute improvement of the validation loss that counts. Absolute, since a NLL is often negative.
    plateau_threshold: float = 1e-4
    # "plateau": the paper's. "cosine": from the learning rate to zero over all steps, which `steps_per_epoch` must say.
    schedule: Literal["plateau", "cosine"] = "plateau"
    # Decoupled weight decay (AdamW). 0: Adam, the paper's.
    weight_decay: float = 0.0
    # Largest global norm of the gradient; 0 turns clipping off. Not given in the paper.
    gradient_clip: float = 10.0
    # "sequence": equations 6 and 7, minus the log of the mean likelihood. "mean": the mean of the NLLs.
    reduction: Literal["sequence", "mean"] = "sequence"
    # Beta-NLL (Seitzer et al. 2022): weights each NLL by sigma^(2 beta), sigma in standardised units and without a
    # gradient, so that steps of large sigma still teach the mean. 0: the paper's NLL. For "mean" only.
    beta: float = 0.0
    # Weight of the rotation in DeepVO's loss (its paper: 100), for head "regression" only.
    kappa: float = 100.0
    # Stack parameters made by bin/convert_flownet; empty: Xavier everywhere. Paper: FlowNet.
    initial_stack: str = ""
    # Start from the whole of another training: "shipped" for the weights of the package, or a checkpoint's folder. Its
    # statistics of the labels, which are the units of the outputs, are taken over. model.width and model.lstm_hidden
    # may be larger than there: the network then begins with the same outputs. Empty: from scratch.
    initial_weights: str = ""
    # Steps of an epoch that may be skipped because the loss, the gradient or another metric is not finite: they leave
    # the network as it is and are counted in metrics.csv. 0: the first such step ends the training.
    skip_nonfinite: int = 0
    # Where a checkpoint or a log cannot be written, because the disk is full say: "stop" ends the training, "go_on"
    # says so and tries again with the next one. What was written before stays whole.
    full_disk: Literal["stop", "go_on"] = "stop"
    # Checkpoints to keep: the newest ones, beside the best.
    keep_latest: int = 2


@dataclasses.dataclass(frozen=True)
class Config:
    """One experiment."""

    image: ImageConfig = ImageConfig()
    model: ModelConfig = ModelConfig()
    data: DataConfig = DataConfig()
    training: TrainingConfig = TrainingConfig()


def load_config(path: str) -> Config:
    """Run the Python file at `path` and return the `Config` it assigns to the name `config`.

    Raises:
      InputError: there is no such file, it does not run, or it assigns no `Config`.
    """
    if not Path(path).is_file():
        raise InputError(f"no config file {path!r}: expected a Python file such as configs/kitti_small.py")
    try:
        found = runpy.run_path(path).get("config")
    except Exception as error:
        raise InputError(f"the config file {path} does not run: {type(error).__name__}: {error}") from error
    if not isinstance(found, Config):
        raise InputError(
            f"{path} assigns {type(found).__name__} to the name `config`: expected a mdnvo_jax.config.Config"
        )
    return found


def as_json(config: Config) -> str:
    """Return `config` as indented JSON."""
    return json.dumps(dataclasses.asdict(config), indent=2) + "\n"


def from_json(text: str) -> Config:
    """Return the `Config` that `as_json` wrote.

    Raises:
      InputError: a section or a field is unknown, or the text is no JSON object.
    """
    try:
        stored = json.loads(text)
        sections = {}
        for section in dataclasses.fields(Config):
            kind = typing.get_type_hints(Config)[section.name]
            values = {name: tuple(v) if isinstance(v, list) else v for name, v in stored[section.name].items()}
            sections[section.name] = kind(**values)
        return Config(**sections)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"unreadable stored configuration ({error}): expected one written by this version") from error


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """Add an option `--SECTION.FIELD` to `parser` for every field of a `Config`."""
    for section in dataclasses.fields(Config):
        kind = typing.get_type_hints(Config)[section.name]
        group = parser.add_argument_group(section.name, (kind.__doc__ or "").splitlines()[0])
        for name, hint in typing.get_type_hints(kind).items():
            group.add_argument(
                f"--{section.name}.{name}", dest=f"{section.name}.{name}", default=None, **_argument(hint)
            )


def apply_overrides(config: Config, options: argparse.Namespace) -> Config:
    """Return `config` with every option that `add_overrides` added and the user gave."""
    for section in dataclasses.fields(Config):
        given = {
            name.removeprefix(f"{section.name}."): tuple(value) if isinstance(value, list) else value
            for name, value in vars(options).items()
            if name.startswith(f"{section.name}.") and value is not None
        }
        config = dataclasses.replace(
            config, **{section.name: dataclasses.replace(getattr(config, section.name), **given)}
        )
    return config


def _argument(hint: Any) -> dict[str, Any]:
    """Return the keyword arguments of `add_argument` for a field of type `hint`."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return {"choices": arguments}
    if origin is tuple:
        return {"type": arguments[0], "nargs": "*", "metavar": arguments[0].__name__.upper()}
    if hint is bool:
        return {"type": _boolean, "metavar": "{true,false}"}
    assert not isinstance(hint, types.UnionType), "a field has one type: an empty value stands for 'not set'"
    return {"type": hint, "metavar": hint.__name__.upper()}


def _boolean(text: str) -> bool:
    """Return the truth value of the words true and false."""
    if text.lower() not in ("true", "false"):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected true or false")
    return text.lower() == "true"


def intrinsics(text: str) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of an option such as `--camera 718.9,718.9,607.2,185.2`."""
    try:
        fx, fy, cx, cy = (float(value) for value in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected four numbers fx,fy,cx,cy") from None
    return fx, fy, cx, cy
