"""Make the point spread of a scan an isotropic Gaussian: blur what is sharper, undo what overshoots."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array

Grey = NDArray[np.float32]

# A Gaussian ends here, in widths: the rest is 3e-7.
_TAIL = 5.0


def equalise_blur(grey: Grey, covariance_mm2: Array, spacing_mm: Array) -> Grey:
    """Blur grey values [z, y, x] until the point spread is as wide in all directions as in its widest.

    Parameters
    ----------
    grey : ndarray of float32, [z, y, x]
    covariance_mm2 : ndarray, (3, 3)
        Of the point spread, along x, y, z.
    spacing_mm : ndarray, (3,)

    Notes
    -----
    A product with the Gaussian of the missing covariance in frequency space; the border mirrors values.
    """
    from scipy.fft import irfftn, next_fast_len, rfftn

    size, axes = np.linalg.eigh(covariance_mm2)
    more = ((axes * (size[-1] - size)) @ axes.T)[::-1, ::-1]
    spacing = np.asarray(spacing_mm)[::-1]
    margin = np.ceil(_TAIL * np.sqrt(np.maximum(np.diag(more), 0.0)) / spacing).astype(int)
    margin = np.minimum(margin, np.array(grey.shape) - 1)
    pads = []
    for n, m in zip(grey.shape, margin.tolist(), strict=True):
        wanted = int(next_fast_len(n + 2 * m, real=True))
        pads.append((m, max(0, min(wanted - n - m, n - 1))))
    padded = np.pad(grey, pads, mode="symmetric")
    k = _frequencies(padded.shape, spacing)
    power = sum(more[i, j] * k[i] * k[j] for i in range(3) for j in range(3))
    even = irfftn(rfftn(padded) * np.exp(-0.5 * power).astype(np.float32), padded.shape)
    inner = tuple(slice(m, m + n) for (m, _), n in zip(pads, grey.shape, strict=True))
    return np.ascontiguousarray(even[inner], dtype=np.float32)


def _frequencies(shape: tuple[int, ...], spacing: Array) -> list[Array]:
    """Return angular frequencies per mm along z, y, x, each shaped to broadcast."""
    along = [
        np.fft.fftfreq(shape[0], spacing[0]),
        np.fft.fftfreq(shape[1], spacing[1]),
        np.fft.rfftfreq(shape[2], spacing[2]),
    ]
    shaped = [[-1, 1, 1], [1, -1, 1], [1, 1, -1]]
    return [2.0 * np.pi * f.reshape(shape) for f, shape in zip(along, shaped, strict=True)]


def retrieve_phase(grey: Grey, sharpening_mm2: float, spacing_mm: Array) -> Grey:
    """Undo the operator 1 - f Laplacian on grey values [z, y, x].

    Parameters
    ----------
    grey : ndarray of float32, [z, y, x]
    sharpening_mm2 : float
        f.
    spacing_mm : ndarray, (3,)

    Notes
    -----
    1 / (1 + f k^2) in frequency space (Paganin et al. 2002, doi:10.1046/j.1365-2818.2002.01010.x, for one
    material; it acts on the reconstruction as on its projections). Cosines mirror the values at the border.
    """
    from scipy.fft import dctn, idctn

    along = [np.pi * np.arange(n) / (n * h) for n, h in zip(grey.shape, spacing_mm[::-1], strict=True)]
    total = along[0][:, None, None] ** 2 + along[1][:, None] ** 2 + along[2] ** 2
    waves = dctn(grey, overwrite_x=False)
    waves /= (1.0 + sharpening_mm2 * total).astype(np.float32)
    return np.asarray(idctn(waves, overwrite_x=True), dtype=np.float32)
