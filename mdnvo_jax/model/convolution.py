"""One convolution, whose backward pass is fast on a processor too.

XLA's CPU backend runs a convolution forward near the speed of its matrix product and backward several times slower: the
gradient of the input as a convolution of a map that is mostly zeros (strided layers), that of the kernel as a
convolution with a kernel as large as the map. Here both are put in a form that is fast there:

- the input's gradient as `stride`^2 ordinary convolutions, one for each phase (row and column modulo the stride) of
  the input, whose kernels are the taps that reach that phase: no product with a zero is left;
- the kernel's gradient as matrix products of columns with the cotangent, a band of rows of an image at a time. The
  input is laid out by phase and channel with pixels last, where every tap is one long run of memory.

Elsewhere, and where a map is so small that the plain form wins, it is `jax.lax.conv_general_dilated` and its own
derivative. The choice is made when a program is lowered for a platform, so that an exported program holds for each.
Derivatives are for reverse mode: `jax.grad` and `jax.vjp`, not `jax.jvp`.

Products. "float32" is exact to rounding. "mixed" rounds the factors of every product to bfloat16 and sums in float32,
on GPU and TPU. On a processor it does so for the kernel's gradient alone, and only where there are matrix units for it
(AMX): without them bfloat16 is the slower type, and "mixed" is "float32".
"""

import functools
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array, lax

Products = Literal["float32", "mixed"]

# Output pixels of an image from which on columns beat XLA's own gradient of the kernel (BENCHMARKS.md).
_COLUMNS_FROM_PIXELS = 256
# Values in the columns of one product, at most: what stays near the processor's caches.
_COLUMNS_VALUES = 2**21
# Such products in a turn of the loop that adds them, where there are more than so many.
_UNROLLED, _WORTH_UNROLLING = 4, 64


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3, 4))
def convolve(x: Array, kernel: Array, stride: int, padding: int, products: Products = "float32") -> Array:
    """Return the cross-correlation of `x` with `kernel`: the one place where the model convolves.

    Args:
      x: maps `[N, H, W, C]`.
      kernel: weights `[k, k, C, D]`, of the type of `x` or a finer one, which is that of its gradient.
      stride: step in pixels, the same in both directions.
      padding: zeros added on each of the four sides.
      products: "float32" or "mixed", see above.

    Returns:
      `[N, (H + 2 * padding - k) // stride + 1, ..., D]`.
    """
    plain = functools.partial(_plain, stride=stride, padding=padding)
    if products == "float32":
        return plain(x, kernel)
    rounded = functools.partial(plain, rounding=jnp.bfloat16)
    return lax.platform_dependent(x, kernel, cpu=plain, default=rounded)


def _plain(x: Array, kernel: Array, *, stride: int, padding: int, rounding: jnp.dtype | None = None) -> Array:
    """Return `lax`'s convolution of factors that are rounded to a type, summed in that of `x`."""
    kind = x.dtype if rounding is None else rounding
    return lax.conv_general_dilated(
        x.astype(kind),
        kernel.astype(kind),
        (stride, stride),
        [(padding, padding)] * 2,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        preferred_element_type=x.dtype,
    )


def _forward(
    x: Array, kernel: Array, stride: int, padding: int, products: Products
) -> tuple[Array, tuple[Array, Array]]:
    return convolve(x, kernel, stride, padding, products), (x, kernel)


def _backward(
    stride: int, padding: int, products: Products, saved: tuple[Array, Array], g: Array
) -> tuple[Array, Array]:
    plain = functools.partial(_plain, stride=stride, padding=padding)

    def cpu(x: Array, kernel: Array, g: Array) -> tuple[Array, Array]:
        kind = jnp.bfloat16 if products == "mixed" and has_matrix_units() else x.dtype
        input_gradient = _input_gradient(g, kernel.astype(x.dtype), x.shape, stride, padding)
        kernel_gradient = _kernel_gradient(g, x, kernel.shape, stride, padding, kind)
        return input_gradient, kernel_gradient.astype(kernel.dtype)

    def elsewhere(x: Array, kernel: Array, g: Array) -> tuple[Array, Array]:
        kind = jnp.bfloat16 if products == "mixed" else x.dtype
        gradients = jax.vjp(plain, x.astype(kind), kernel.astype(kind))[1](g.astype(kind))
        return gradients[0].astype(x.dtype), gradients[1].astype(kernel.dtype)

    return lax.platform_dependent(*saved, g, cpu=cpu, default=elsewhere)


convolve.defvjp(_forward, _backward)


@functools.cache
def has_matrix_units() -> bool:
    """Return whether this machine's processor multiplies matrices of bfloat16 in hardware (AMX), as Linux tells."""
    information = Path("/proc/cpuinfo")
    return information.is_file() and "amx_bf16" in information.read_text().split()


def _input_gradient(g: Array, kernel: Array, shape: tuple[int, ...], stride: int, padding: int) -> Array:
    """Return the gradient `[N, H, W, C]` of the input from the cotangent `[N, h, w, D]`.

    Pixel u of the padded input meets output i in tap t = u - stride * i. All u of one phase u % stride = r meet the
    taps r, r + stride, ..., each with outputs next to each other: an ordinary convolution with these taps, reversed.
    """

    def phase(size: int, outputs: int, offset: int) -> tuple[int, tuple[int, int]]:
        """Return the first tap and the padding of the convolution for the pixels offset, offset + stride, ..."""
        first, tap = divmod(offset + padding, stride)
        taps = len(range(tap, kernel.shape[0], stride))
        before = taps - 1 - first
        return tap, (before, -(-size // stride) + taps - 1 - before - outputs)

    def pixels(row: int, column: int) -> Array:
        (top, vertical), (left, horizontal) = phase(shape[1], g.shape[1], row), phase(shape[2], g.shape[2], column)
        taps = kernel[top::stride, left::stride]
        if 0 in taps.shape:  # a stride beyond the kernel's size skips pixels
            return jnp.zeros((g.shape[0], -(-shape[1] // stride), -(-shape[2] // stride), shape[3]), g.dtype)
        return lax.conv_general_dilated(
            g, jnp.flip(taps, (0, 1)), (1, 1), (vertical, horizontal), dimension_numbers=("NHWC", "HWOI", "NHWC")
        )

    rows = [jnp.stack([pixels(row, column) for column in range(stride)], axis=3) for row in range(stride)]
    phases = jnp.stack(rows, axis=2)  # [N, H / stride, stride, W / stride, stride, C]
    size = phases.shape[1] * stride, phases.shape[3] * stride
    return phases.reshape(g.shape[0], *size, shape[3])[:, : shape[1], : shape[2]]


def _kernel_gradient(g: Array, x: Array, shape: tuple[int, ...], stride: int, padding: int, kind: jnp.dtype) -> Array:
    """Return the gradient `[k, k, C, D]` of the kernel from the cotangent `[N, h, w, D]` and the input.

    In the phase (row % stride, column % stride) of the padded input, tap (y, z) of output (i, j) is the pixel
    (i + y // stride, j + z // stride): of rows laid end to end, a run that starts y // stride rows and z // stride
    pixels in. The outputs get as many columns as a phase has, zero in those that do not exist. Factors are rounded to
    the type `kind`.
    """
    images, rows, row_pixels, outputs = g.shape
    size, channels = shape[0], shape[2]
    if rows * row_pixels < _COLUMNS_FROM_PIXELS:
        plain = functools.partial(_plain, x, stride=stride, padding=padding)
        return jax.vjp(plain, jnp.zeros(shape, x.dtype))[1](g)[0]
    reach = -(-size // stride)
    width = row_pixels + reach - 1
    bands = -(-size * size * channels * rows * width // _COLUMNS_VALUES)
    band = -(-rows // bands)
    # One row more than the taps reach, so that the last run is as long as the others.
    height = bands * band + reach
    after = height * stride - x.shape[1] - padding, width * stride - x.shape[2] - padding
    # bfloat16 moves as whole numbers: XLA's CPU backend slices and joins it by way of float32.
    carrier = jnp.uint16 if kind == jnp.bfloat16 else kind
    total = jnp.zeros((size * size * channels, outputs), jnp.promote_types(x.dtype, jnp.float32))
    x, g = (lax.bitcast_convert_type(array.astype(kind), carrier) for array in (x, g))
    x = lax.pad(x, jnp.zeros((), carrier), ((0, 0, 0), (padding, after[0], 0), (padding, after[1], 0), (0, 0, 0)))
    phases = x.reshape(images, height, stride, width, stride, channels).transpose(0, 2, 4, 5, 1, 3)
    g = jnp.pad(g, ((0, 0), (0, bands * band - rows), (0, width - row_pixels), (0, 0)))
    g = g.reshape(images * bands, band * width, outputs)

    def add_band(total: Array, index: Array) -> tuple[Array, None]:
        start = (index // bands, 0, 0, 0, index % bands * band, 0)
        near = lax.dynamic_slice(phases, start, (1, stride, stride, channels, band + reach, width))
        near = near.reshape(stride, stride, channels, -1)
        starts = [(y, z, y // stride * width + z // stride) for y in range(size) for z in range(size)]
        taps = [near[y % stride, z % stride, :, start : start + band * width] for y, z, start in starts]
        columns = lax.bitcast_convert_type(jnp.concatenate(taps), kind)
        cotangent = lax.bitcast_convert_type(lax.dynamic_index_in_dim(g, index, keepdims=False), kind)
        return total + lax.dot(columns, cotangent, preferred_element_type=total.dtype), None

    # What is unrolled takes longer to compile, which a short sum does not win back.
    unroll = _UNROLLED if images * bands > _WORTH_UNROLLING else 1
    total, _ = lax.scan(add_band, total, jnp.arange(images * bands), unroll=unroll)
    return total.reshape(shape)
