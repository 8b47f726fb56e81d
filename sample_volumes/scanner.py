"""What a scanner does to the grey values after the blur: cupping, noise, and the numbers it stores."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from sample_volumes.ear import Ear

Floats = NDArray[np.float32]
DTYPES = ("uint8", "int16", "uint16", "float32")
_OFFSET = {"uint8": 0.0, "int16": -32768.0, "uint16": 0.0, "float32": 0.0}
_FACTOR = {"uint8": 1.0 / 257.0, "int16": 1.0, "uint16": 1.0, "float32": 1.0}
_SLICE_OF_SEED = 1 << 20


def cup(grey: Floats, cupping: float) -> None:
    """Darken a slab (z, y, x) of contrast towards the z axis in its middle, by a share of it, in place.

    Beam hardening as it is left after a scanner's own correction: a parabola that vanishes at the border.
    """
    _, ny, nx = grey.shape
    x = (np.arange(nx) - 0.5 * (nx - 1)) / (0.5 * nx)
    y = (np.arange(ny) - 0.5 * (ny - 1)) / (0.5 * ny)
    radius2 = np.minimum(x[None, :] ** 2 + y[:, None] ** 2, 1.0)
    grey *= (1.0 - cupping * (1.0 - radius2)).astype(np.float32)


def add_noise(grey: Floats, first: int, ear: Ear) -> None:
    """Add Gaussian noise to slices from slice ``first`` on, in place; it does not depend on the slabs.

    With ``noise_correlation_voxels`` above 0, white noise is blurred by that sigma and brought back to its
    standard deviation.
    """
    count, ny, nx = grey.shape
    if ear.noise_correlation_voxels <= 0.0:
        for k in range(count):
            rng = np.random.default_rng([ear.noise_seed, first + k])
            grey[k] += np.float32(ear.noise) * rng.standard_normal((ny, nx), dtype=np.float32)
        return
    from scipy.ndimage import correlate1d

    sigma = ear.noise_correlation_voxels
    reach = int(np.ceil(4.0 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    kernel = (kernel / np.sqrt((kernel**2).sum())).astype(np.float32)
    white = np.empty((count + 2 * reach, ny, nx), dtype=np.float32)
    for k in range(len(white)):
        rng = np.random.default_rng([ear.noise_seed, _SLICE_OF_SEED + first + k - reach])
        rng.standard_normal(out=white[k], dtype=np.float32)
        for axis in (0, 1):
            white[k] = correlate1d(white[k], kernel, axis=axis, mode="wrap")
    blurred = correlate1d(white, kernel, axis=0, mode="wrap")[reach : reach + count]
    grey += np.float32(ear.noise) * blurred


def stored(grey: Floats, air: float, dtype: str) -> NDArray[Any]:
    """Return grey values above air as numbers of a file's type; integers are rounded and clipped.

    Grey values 0 to 65535 become 0 to 255 for uint8 and -32768 to 32767 for int16. The array is overwritten.
    """
    factor, offset = _FACTOR[dtype], _OFFSET[dtype]
    if factor != 1.0:
        grey *= np.float32(factor)
    if dtype == "float32":
        grey += np.float32(air)
        return grey
    ends = np.iinfo(dtype)
    grey += np.float32(air * factor + offset + 0.5)
    np.floor(grey, out=grey)
    return np.clip(grey, ends.min, ends.max, out=grey).astype(dtype)


def stored_levels(levels: tuple[float, ...], dtype: str) -> list[float]:
    """Return grey levels as they appear in a file of that type, before rounding."""
    return [level * _FACTOR[dtype] + _OFFSET[dtype] for level in levels]
