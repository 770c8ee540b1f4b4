"""The network: frame pairs through the convolutions, their features through the BiLSTM, a dense layer at the end."""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from mdnvo_jax.config import ImageConfig, ModelConfig
from mdnvo_jax.model.bilstm import LstmParams, bilstm, init_lstm
from mdnvo_jax.model.conv import FLOW_LAYERS, LAYERS, ConvStack, layer_channels, map_size
from mdnvo_jax.model.head import raw_size
from mdnvo_jax.model.normalise import normalise

Variables = dict[str, Any]


class Network(nn.Module):
    """The whole network, in float32 but for `ModelConfig.activations`.

    Its parameters are `stack` (`conv.ConvStack`), `lstm` (`bilstm.init_lstm`), and `head`. It is what is trained;
    prediction runs the same function in parts, see `fold`. Inside a `jax.pmap` over parts of a batch, `axis_name` is
    that of its axis: batch normalisation then sees the whole batch.
    """

    image_config: ImageConfig
    model_config: ModelConfig
    axis_name: str | None = None

    def setup(self) -> None:
        """Declare the three parts."""
        config = self.model_config
        self.stack = ConvStack(
            config.width,
            config.conv_dropout,
            config.products,
            config.batch_norm_momentum,
            config.activations,
            config.rematerialise,
            self.axis_name,
        )
        self.lstm: LstmParams = self.param(
            "lstm",
            functools.partial(
                init_lstm,
                features=feature_size(self.image_config, config),
                hidden=config.lstm_hidden,
                layers=config.lstm_layers,
                bidirectional=config.bidirectional,
            ),
        )
        self.head = nn.Dense(raw_size(config), kernel_init=nn.initializers.glorot_uniform())
        if config.flow_weight:
            self.flow = nn.Conv(2, (1, 1), kernel_init=nn.initializers.glorot_uniform())

    def __call__(self, images: Array, mask: Array, *, train: bool = False) -> Array:
        """Return the raw outputs of every step of windows of frames.

        Args:
          images: `[B, T+1, H, W, C]` uint8; step t is the pair of frames t and t + 1.
          mask: `[B, T]`, false for steps that are padding or that a bad frame spoils. They touch neither the other
            steps' outputs nor the batch statistics; their own outputs mean nothing.
          train: whether to use dropout (needs `rngs={"dropout": key}`) and the batch's statistics (needs
            `mutable=["batch_stats"]`).

        Returns:
          `[B, T, D]` in standardised units, D of `head.raw_size`; see `head.mixture_from_outputs`.
        """
        return self.with_flow(images, mask, train=train)[0]

    def with_flow(self, images: Array, mask: Array, *, train: bool = False) -> tuple[Array, Array | None]:
        """Return (the outputs of `__call__`, optical flow where `model_config.flow_weight` asks for it).

        The flow is that from the first frame of a pair to the second, in pixels of a map of `flow_size`,
        `[B, T, h, w, 2]`. Only training uses it: prediction never computes it.
        """
        batch, frames = images.shape[:2]
        if mask.shape != (batch, frames - 1):
            raise ValueError(f"images {images.shape} and mask {mask.shape}: expected a mask of {(batch, frames - 1)}")
        expected = (self.image_config.height, self.image_config.width, self.image_config.channels)
        if images.shape[2:] != expected:
            raise ValueError(f"found frames of shape {images.shape[2:]}, expected {expected} as in the image config")
        normalised = normalise(images, self.image_config.normalisation)
        pairs = jnp.concatenate([normalised[:, :-1], normalised[:, 1:]], axis=-1)
        maps = self.stack.maps(pairs.reshape(batch * (frames - 1), *pairs.shape[2:]), mask.reshape(-1), train=train)
        features = maps[-1].reshape(batch, frames - 1, -1)
        dropout = self.model_config.lstm_dropout
        rng = self.make_rng("dropout") if train and dropout > 0 else None
        outputs = self.head(bilstm(self.lstm, features, mask, dropout=dropout, rng=rng))
        if not self.model_config.flow_weight:
            return outputs, None
        flow = self.flow(maps[len(FLOW_LAYERS) - 1])
        return outputs, flow.reshape(batch, frames - 1, *flow.shape[1:])


def build(image_config: ImageConfig, model_config: ModelConfig, axis_name: str | None = None) -> Network:
    """Return the network for images and sizes of a configuration; for `axis_name` see `Network`."""
    return Network(image_config, model_config, axis_name)


def feature_size(image_config: ImageConfig, model_config: ModelConfig) -> int:
    """Return the number of features F of a pair: the stack's last maps, flattened."""
    rows, columns = map_size(image_config.height, image_config.width)
    return rows * columns * layer_channels(LAYERS[-1], model_config.width)


def flow_size(image_config: ImageConfig) -> tuple[int, int]:
    """Return rows and columns of the maps that optical flow is read off: `conv.FLOW_STRIDE` pixels in one."""
    return map_size(image_config.height, image_config.width, FLOW_LAYERS)


def initialise(network: Network, rng: Array, image_config: ImageConfig, steps: int) -> Variables:
    """Return fresh variables: Xavier kernels, zero biases, unit scales; `{"params": ..., "batch_stats": ...}`.

    Compiled, so that the forward pass that flax traces for the shapes is never computed.

    Args:
      network: of `build`.
      rng: a PRNG key, the only source of randomness.
      image_config: of the network.
      steps: length of a window, at least 1; no shape depends on it.
    """
    init = functools.partial(_init, network, image_config, steps)
    # One small program a kernel's shape, each run once: on a CPU, optimising them takes seconds and gains nothing.
    on_cpu = jax.default_backend() == "cpu"
    options: dict[str, str | bool] = {"xla_backend_optimization_level": "0"} if on_cpu else {}
    return jax.jit(init).lower(rng).compile(compiler_options=options)(rng)


def template(network: Network, image_config: ImageConfig, steps: int) -> Variables:
    """Return the shapes and types of the variables as `jax.ShapeDtypeStruct`, without computing any."""
    return jax.eval_shape(functools.partial(_init, network, image_config, steps), jax.random.key(0))


def _init(network: Network, image_config: ImageConfig, steps: int, rng: Array) -> Variables:
    """Return the variables that flax makes for one window."""
    frame = (image_config.height, image_config.width, image_config.channels)
    return network.init(rng, jnp.zeros((1, steps + 1, *frame), jnp.uint8), jnp.ones((1, steps), bool))
