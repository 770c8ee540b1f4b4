"""The half of the preprocessing that runs on the device: frames of bytes become the floats the network reads."""

from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

Normalisation = Literal["standard", "local_contrast", "flownet"]

# Mean colour of FlowNet's training frames in [0, 1], as the FlowNet code and its ports subtract it. They list it for
# BGR (0.411, 0.432, 0.450); our frames are RGB. `bin/convert_flownet` fits the weights to that.
FLOWNET_MEAN_RGB = (0.450, 0.432, 0.411)
# The same in grey, by the luma weights that decoders make grey with.
FLOWNET_MEAN_GREY = 0.299 * 0.450 + 0.587 * 0.432 + 0.114 * 0.411

# Local contrast. The window's standard deviation is a share of the image height, so that it covers the same part of
# the scene at any resolution.
_WINDOW_SHARE = 1 / 16
# Added to the local deviation of the square root of intensity: 3.6 grey levels of 255 at mid-grey. Asphalt in KITTI has
# two to seven times that; much less (sky, the last bit of rounding) fades instead of being blown up.
_CONTRAST_FLOOR = 0.01
_CONTRAST_LIMIT = 4.0


def normalise(images: Array, how: Normalisation) -> Array:
    """Return frames as the network reads them.

    - "standard": x / 255 - 0.5.
    - "flownet": x / 255 minus the mean colour of FlowNet's training frames, for weights of `bin/convert_flownet`.
    - "local_contrast": of the square root s of x / 255, (s - m) / (d + 0.01), clipped to +-4, where m is the mean under
      a Gaussian window and d the root of the mean of (s - m)^2 under it. Channel by channel. Exposure, haze and
      shading go, texture stays: rendered and real frames come to look alike. Flat frames give zeros.

    Args:
      images: uint8 `[..., H, W, C]`, C = 1 grey or 3 RGB.
      how: one of the three names.

    Returns:
      float32 of the same shape.

    Raises:
      ValueError: `images` are not uint8, have another number of channels, or `how` is unknown.
    """
    if images.dtype != jnp.uint8:
        raise ValueError(f"found images of {images.dtype}, expected uint8")
    if images.shape[-1] not in (1, 3):
        raise ValueError(f"found images of shape {images.shape}, expected [..., H, W, C] with C = 1 or 3")
    intensity = jnp.asarray(images).astype(jnp.float32) / 255
    match how:
        case "standard":
            return intensity - 0.5
        case "flownet":
            mean = FLOWNET_MEAN_RGB if images.shape[-1] == 3 else (FLOWNET_MEAN_GREY,)
            return intensity - jnp.asarray(mean, jnp.float32)
        case "local_contrast":
            return _local_contrast(intensity)
    raise ValueError(f"found normalisation {how!r}, expected one of {', '.join(get_args(Normalisation))}")


def _local_contrast(intensity: Array) -> Array:
    """Return the local contrast of `intensity` in [0, 1], `[..., H, W, C]`."""
    height, width = intensity.shape[-3:-1]
    sigma = max(1.0, height * _WINDOW_SHARE)
    rows, columns = _gaussian(height, sigma), _gaussian(width, sigma)

    def blur(x: Array) -> Array:
        # As two products with banded matrices: matrix units and BLAS beat a convolution with so wide a window.
        x = jnp.einsum("Hh,...hwc->...Hwc", rows, x, precision=jax.lax.Precision.HIGHEST)
        return jnp.einsum("Ww,...hwc->...hWc", columns, x, precision=jax.lax.Precision.HIGHEST)

    root = jnp.sqrt(intensity)
    centred = root - blur(root)
    contrast = centred / (jnp.sqrt(blur(jnp.square(centred))) + _CONTRAST_FLOOR)
    return jnp.clip(contrast, -_CONTRAST_LIMIT, _CONTRAST_LIMIT)


def _gaussian(size: int, sigma: float) -> np.ndarray:
    """Return the matrix `[size, size]` that blurs a line of pixels, its ends repeated outwards; rows sum to one."""
    reach = int(np.ceil(3 * sigma))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights /= weights.sum()
    matrix = np.zeros((size, size))
    for row in range(size):
        np.add.at(matrix[row], np.clip(np.arange(row - reach, row + reach + 1), 0, size - 1), weights)
    return matrix.astype(np.float32)
