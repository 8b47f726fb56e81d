"""The scanner's blur, read off the edges of the bone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_REACH = 4
_MOST = 12_000
_LEAST = 60


def edge_sigma(
    grey: NDArray[np.float32],
    near_edge: NDArray[np.bool_],
    air: float,
    bone: float,
    spacing_mm: Array,
    noise: float = 0.0,
    seed: int = 0,
) -> tuple[float, float] | None:
    """Estimate the standard deviation of the point spread (voxel included) from edges of bone in air.

    Parameters
    ----------
    grey : ndarray of float32, [z, y, x]
    near_edge : ndarray of bool, [z, y, x]
        Where to look; voxels of middle grey value are taken from it.
    air, bone : float
        Grey levels.
    spacing_mm : ndarray, (3,)
    noise : float
        Standard deviation of a voxel, in shares of bone minus air.
    seed : int
        Of the choice among many voxels.

    Returns
    -------
    sigma_mm, sd_mm : float
        None when there are too few clean edges.

    Notes
    -----
    Across a plane edge blurred by a Gaussian, w = Phi(d / s) and |grad w| = phi(d / s) / s, so that every
    voxel near the middle gives s = phi(Phi^-1(w)) / |grad w|. w and its gradient are taken with a Gaussian
    of known width, whose variance is subtracted. Edges that do not reach bone on one side and air on the
    other within a few widths (thin walls, corners, gaps) are left out.
    """
    from scipy.ndimage import map_coordinates
    from scipy.special import ndtri

    r = _REACH
    level = (grey - air) / (bone - air)
    inner = np.zeros_like(near_edge)
    inner[r:-r, r:-r, r:-r] = near_edge[r:-r, r:-r, r:-r]
    index = np.stack(np.nonzero(inner & (np.abs(level - 0.5) < 0.3)), axis=1)
    if len(index) < _LEAST:
        return None
    if len(index) > _MOST:
        index = np.random.default_rng(seed).permutation(index)[:_MOST]
    spacing = np.asarray(spacing_mm)[::-1]
    width = float(spacing.mean())
    offsets = np.arange(-r, r + 1)
    kernels = [np.exp(-0.5 * (offsets * h / width) ** 2) for h in spacing]
    smooth = [k / k.sum() for k in kernels]
    slope = [k * (offsets * h) / (k @ (offsets * h) ** 2) for k, h in zip(kernels, spacing, strict=True)]
    patch = np.arange(-r, r + 1)
    blocks = level[
        (index[:, 0, None] + patch)[:, :, None, None],
        (index[:, 1, None] + patch)[:, None, :, None],
        (index[:, 2, None] + patch)[:, None, None, :],
    ].astype(float)

    def weighted(a: Array, b: Array, c: Array) -> Array:
        return np.asarray(np.einsum("nijk,i,j,k->n", blocks, a, b, c, optimize=True))

    w = weighted(*smooth)
    gradient = np.stack(
        [weighted(*(slope[m] if m == axis else smooth[m] for m in range(3))) for axis in range(3)], axis=1
    )
    size = np.linalg.norm(gradient, axis=1)
    # Noise lengthens every gradient: its share of the square is known for white noise.
    spread = noise**2 * sum(
        np.prod([((slope[m] if m == axis else smooth[m]) ** 2).sum() for m in range(3)]) for axis in range(3)
    )
    size = np.sqrt(np.maximum(size**2 - spread, 1e-12))
    good = (np.abs(w - 0.5) < 0.25) & (size > 0.05 / width)
    w, size, gradient, index = w[good], size[good], gradient[good], index[good]
    if len(w) < _LEAST:
        return None
    z = ndtri(w)
    total = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) / size
    middle = float(np.median(total))
    inward = gradient / size[:, None]
    foot = index * spacing - z[:, None] * middle * inward
    sides = []
    for reach in (-2.6, 2.6, 3.6):
        points = (foot + reach * middle * inward) / spacing
        sides.append(map_coordinates(level, points.T, order=1, mode="nearest"))
    slack = max(0.15, 2.5 * noise)
    clean = (np.abs(sides[0]) < slack) & (np.abs(sides[1] - 1.0) < slack) & (np.abs(sides[2] - 1.0) < slack)
    if np.count_nonzero(clean) < _LEAST:
        clean = np.abs(sides[0]) < slack + 0.05
    if np.count_nonzero(clean) < _LEAST:
        return None
    variance = np.median(total[clean]) ** 2 - width**2
    if not variance > 0.0:
        return 0.3 * width, 0.1 * width
    sigma = float(np.sqrt(variance))
    low, high = np.percentile(total[clean], [25.0, 75.0])
    spread = 0.5 * float(high - low) / np.sqrt(max(len(w) / 50.0, 1.0)) + 0.02 * float(np.median(total))
    return sigma, spread * float(np.median(total)) / sigma
