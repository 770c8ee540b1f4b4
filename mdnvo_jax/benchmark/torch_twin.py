"""Our network as one would write it in PyTorch, on our weights: what training and prediction are measured against.

Best form: modules of `torch.nn` (oneDNN below them), channels_last where that is faster, Adam fused. It imports torch
at its head: only sections that found torch import this module.
"""

import copy
import math
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import fusion

from mdnvo_jax.config import Config, ImageConfig
from mdnvo_jax.model.conv import BATCH_NORM_EPSILON, LAYERS, LEAKY_SLOPE, layer_channels
from mdnvo_jax.model.head import STEP_SIZE, Labels
from mdnvo_jax.model.network import feature_size
from mdnvo_jax.model.normalise import FLOWNET_MEAN_GREY, FLOWNET_MEAN_RGB

Layout = Literal["channels_last", "contiguous"]


class Normalise(nn.Module):
    """uint8 `[..., H, W, C]` to the floats that `model.normalise` gives."""

    def __init__(self, image: ImageConfig) -> None:
        super().__init__()
        self.how = image.normalisation
        means = FLOWNET_MEAN_RGB if image.channels == 3 else (FLOWNET_MEAN_GREY,)
        self.register_buffer("mean", torch.tensor(means), persistent=False)
        sigma = max(1.0, image.height / 16)
        self.register_buffer("rows", _blur_matrix(image.height, sigma), persistent=False)
        self.register_buffer("columns", _blur_matrix(image.width, sigma), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Return float32 of the same shape, under autocast too: the blur of a byte image needs more than 8 bits."""
        with torch.autocast("cpu", enabled=False):
            return self.normalised(images)

    def normalised(self, images: Tensor) -> Tensor:
        """Return float32 of the same shape."""
        intensity = images.float() / 255
        if self.how == "standard":
            return intensity - 0.5
        if self.how == "flownet":
            return intensity - self.mean
        root = intensity.sqrt().movedim(-1, -3)
        centred = root - self.blurred(root)
        contrast = centred / (self.blurred(centred.square()).sqrt() + 0.01)
        return contrast.clamp(-4, 4).movedim(-3, -1)

    def blurred(self, x: Tensor) -> Tensor:
        """Return maps `[..., H, W]` under the Gaussian window."""
        return self.rows @ x @ self.columns.T


def _blur_matrix(size: int, sigma: float) -> Tensor:
    """Return the matrix of a Gaussian blur of a line of pixels whose ends are repeated outwards."""
    reach = math.ceil(3 * sigma)
    offsets = torch.arange(-reach, reach + 1)
    kernel = torch.softmax(-0.5 * (offsets.double() / sigma) ** 2, 0)
    sources = (torch.arange(size)[:, None] + offsets).clamp(0, size - 1)
    return torch.zeros(size, size, dtype=torch.double).scatter_add(1, sources, kernel.expand(size, -1)).float()


class Block(nn.Module):
    """Convolution, BatchNorm, LeakyReLU, dropout."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, dropout: float) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, (kernel - 1) // 2, bias=False)
        self.norm = nn.BatchNorm2d(outputs, eps=BATCH_NORM_EPSILON)
        self.activation = nn.LeakyReLU(LEAKY_SLOPE, inplace=True)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor) -> Tensor:
        """Return the maps of the next layer."""
        return self.dropout(self.activation(self.norm(self.conv(x))))


class Twin(nn.Module):
    """The whole network; `forward` takes what ours takes, without a mask."""

    def __init__(self, config: Config, layout: Layout = "channels_last") -> None:
        super().__init__()
        image, model = config.image, config.model
        self.memory_format = torch.channels_last if layout == "channels_last" else torch.contiguous_format
        self.normalise = Normalise(image)
        widths = [2 * image.channels, *(layer_channels(layer, model.width) for layer in LAYERS)]
        self.stack = nn.Sequential(
            *(
                Block(widths[i], widths[i + 1], layer.kernel, layer.stride, model.conv_dropout)
                for i, layer in enumerate(LAYERS)
            )
        )
        self.lstm = nn.LSTM(
            feature_size(image, model),
            model.lstm_hidden,
            model.lstm_layers,
            batch_first=True,
            dropout=model.lstm_dropout if model.lstm_layers > 1 else 0.0,
            bidirectional=model.bidirectional,
        )
        # torch's dropout is between its layers; ours is after the last one too.
        self.lstm_dropout = nn.Dropout(model.lstm_dropout)
        self.head = nn.Linear(model.lstm_hidden * (2 if model.bidirectional else 1), _outputs(config))
        self.to(memory_format=self.memory_format)

    def forward(self, images: Tensor) -> Tensor:
        """Return the raw outputs `[B, T, D]` of windows of frames `[B, T+1, H, W, C]` uint8."""
        batch, frames = images.shape[:2]
        normalised = self.normalise(images)
        pairs = torch.cat([normalised[:, :-1], normalised[:, 1:]], dim=-1)
        features = self.features(pairs.flatten(0, 1))
        return self.outputs_from_features(features.view(batch, frames - 1, -1))

    def pair_features(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the features `[N, F]` of pairs of frames `[N, H, W, C]` uint8."""
        return self.features(torch.cat([self.normalise(first), self.normalise(second)], dim=-1))

    def features(self, pairs: Tensor) -> Tensor:
        """Return the features `[N, F]` of normalised pairs `[N, H, W, 2C]`."""
        maps = (
            pairs.permute(0, 3, 1, 2).to(self.stack[0].conv.weight.dtype).contiguous(memory_format=self.memory_format)
        )
        # In the order of rows, columns, channels: free in channels_last, and the order of our LSTM's weights.
        return self.stack(maps).permute(0, 2, 3, 1).flatten(1)

    def outputs_from_features(self, features: Tensor) -> Tensor:
        """Return the raw outputs `[B, T, D]` of windows of features `[B, T, F]`, in float32 under autocast too.

        torch's LSTM in bf16 took two to eight times as long as in float32 on a processor without AMX.
        """
        with torch.autocast("cpu", enabled=False):
            outputs, _ = self.lstm(features.float())
            return self.head(self.lstm_dropout(outputs))


def _outputs(config: Config) -> int:
    if config.model.head != "mixture":
        raise NotImplementedError("the twin has the paper's head alone")
    return config.model.components * (1 + 2 * STEP_SIZE)


def torch_layout(params: Any) -> dict[str, np.ndarray]:
    """Return our parameters, or a gradient, under the names and in the axes of the twin's."""
    found: dict[str, np.ndarray] = {}
    for index, layer in enumerate(LAYERS):
        ours = params["stack"][layer.name]
        found[f"stack.{index}.conv.weight"] = np.asarray(ours["kernel"]).transpose(3, 2, 0, 1)
        found[f"stack.{index}.norm.weight"] = np.asarray(ours["scale"])
        found[f"stack.{index}.norm.bias"] = np.asarray(ours["bias"])
    for name, directions in params["lstm"].items():
        for direction, ours in directions.items():
            end = f"_l{name.removeprefix('layer')}{'_reverse' if direction == 'backward' else ''}"
            found[f"lstm.weight_ih{end}"] = np.asarray(ours["input_kernel"]).T
            found[f"lstm.weight_hh{end}"] = np.asarray(ours["recurrent_kernel"]).T
            found[f"lstm.bias_ih{end}"] = np.asarray(ours["bias"])
    found["head.weight"] = np.asarray(params["head"]["kernel"]).T
    found["head.bias"] = np.asarray(params["head"]["bias"])
    return found


def copy_weights(twin: Twin, params: Any, batch_stats: Any) -> None:
    """Give the twin our weights and statistics. Its second LSTM bias is zero and stays so: ours has one bias."""
    named = dict(twin.named_parameters())
    with torch.no_grad():
        for name, values in torch_layout(params).items():
            named.pop(name).copy_(torch.from_numpy(np.array(values)))
        for name, parameter in named.items():
            if ".bias_hh" not in name:
                raise AssertionError(f"the twin has {name}, which we have not")
            parameter.zero_().requires_grad_(False)
        for index, layer in enumerate(LAYERS):
            norm = twin.stack[index].norm
            norm.running_mean.copy_(torch.from_numpy(np.array(batch_stats["stack"][layer.name]["mean"])))
            norm.running_var.copy_(torch.from_numpy(np.array(batch_stats["stack"][layer.name]["var"])))


def for_prediction(twin: Twin, dtype: torch.dtype = torch.float32) -> Twin:
    """Return a copy for prediction: BatchNorm folded into the convolutions, and those in `dtype`."""
    folded = copy.deepcopy(twin).eval()
    for block in folded.stack:
        block.conv = fusion.fuse_conv_bn_eval(block.conv, block.norm)
        block.norm = nn.Identity()
    folded.stack.to(dtype)
    return folded.to(memory_format=folded.memory_format).requires_grad_(False)


class Density(nn.Module):
    """From raw outputs to logits `[..., M]`, means and log-scales `[..., M, 6]` in metres and radians."""

    def __init__(self, config: Config, labels: Labels) -> None:
        super().__init__()
        model = config.model
        self.components = model.components
        std = torch.from_numpy(np.array(labels.std))
        floor = torch.tensor([model.translation_floor_m] * 3 + [model.rotation_floor_rad] * 3)
        self.register_buffer("std", std)
        self.register_buffer("shift", torch.from_numpy(np.array(labels.mean)))
        self.register_buffer("log_floor", torch.log(floor / std))
        self.register_buffer("log_std", torch.log(std))

    def forward(self, outputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return logits, means, log-scales."""
        components = self.components
        means, raw = outputs[..., components:].unflatten(-1, (2, components, STEP_SIZE)).unbind(-3)
        log_scale = torch.logaddexp(raw, self.log_floor) + self.log_std
        return outputs[..., :components], means * self.std + self.shift, log_scale


def loss(density: tuple[Tensor, Tensor, Tensor], steps: Tensor, config: Config) -> Tensor:
    """Return the negative log-likelihood of `steps` `[B, T, 6]`, with the coupling and the reduction of `config`."""
    logits, means, log_scale = density
    residual = (steps[..., None, :] - means) * torch.exp(-log_scale)
    terms = -0.5 * (residual.square() + math.log(2 * math.pi)) - log_scale
    log_weights = torch.log_softmax(logits, -1)
    if config.model.coupling == "joint":
        log_likelihood = torch.logsumexp(log_weights + terms.sum(-1), -1)
    else:
        log_likelihood = torch.logsumexp(log_weights[..., None] + terms, -2).sum(-1)
    if config.training.reduction == "sequence":
        log_likelihood = torch.logsumexp(log_likelihood, -1) - math.log(log_likelihood.shape[-1])
    return -log_likelihood.mean()


class Trainer:
    """One step of training after the other, as `training.step.train_step` takes them."""

    def __init__(self, twin: Twin, config: Config, labels: Labels) -> None:
        self.twin, self.config, self.density = twin, config, Density(config, labels)
        self.parameters = [parameter for parameter in twin.parameters() if parameter.requires_grad]
        training = config.training
        self.optimiser = torch.optim.Adam(
            self.parameters, training.learning_rate, betas=(training.beta1, training.beta2), fused=True
        )

    def set_dropout(self, config: Config) -> None:
        """Drop as `config` says."""
        for block in self.twin.stack:
            block.dropout.p = config.model.conv_dropout
        self.twin.lstm.dropout = config.model.lstm_dropout if config.model.lstm_layers > 1 else 0.0
        self.twin.lstm_dropout.p = config.model.lstm_dropout

    def gradient(self, images: Tensor, steps: Tensor, *, autocast: bool = False) -> Tensor:
        """Leave the gradient in the parameters, and return the loss."""
        self.twin.train()
        self.optimiser.zero_grad(set_to_none=True)
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            outputs = self.twin(images)
        value = loss(self.density(outputs.float()), steps, self.config)
        value.backward()
        return value.detach()

    def update(self) -> None:
        """Clip the gradient and take a step of Adam."""
        torch.nn.utils.clip_grad_norm_(self.parameters, self.config.training.gradient_clip, foreach=True)
        self.optimiser.step()

    def step(self, images: Tensor, steps: Tensor, *, autocast: bool = False) -> float:
        """Take one step and return its loss."""
        value = self.gradient(images, steps, autocast=autocast)
        self.update()
        return float(value)
