"""What noise of the surface does to the footplate frame: first-order propagation, no simulation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.surface.surface_field import Diffusion, Patch, step_response
from legacy.stapeskit.arrays import Array

_SECTORS = int(calibrated("footplate_uncertainty.rim_sectors"))
_SI = np.array([1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0])


def height_noise(diffusion: Diffusion, vertices: NDArray[np.intp], normals: Array, grain_mm: float) -> float:
    """Estimate the spectral density of the surface's height noise from vertices (n,) of it, mm4.

    Notes
    -----
    The mean of the height over an area A has the variance density / A. The density is found from the second
    difference of the heights after one, two and three steps of diffusion, a band where noise is larger than
    the curvature of bone, robustly (median absolute deviation) over the face.
    """
    sigma_mm = diffusion.sigma_mm
    once = diffusion.diffused_points
    twice = diffusion.step(once)
    waves = once - 2.0 * twice + diffusion.step(twice)
    inner = np.einsum("ij,ij->i", waves[vertices], normals[vertices])
    if len(inner) == 0:
        return 0.0
    deviation = 1.4826 * float(np.median(np.abs(inner - np.median(inner))))
    k = np.linspace(0.0, 60.0 / sigma_mm, 6001)
    low = step_response(k, sigma_mm)
    band = low * (1.0 - low) ** 2 * _noise_transfer(k, grain_mm)
    share = float(np.sum(k * band**2) * (k[1] - k[0]) / (2.0 * np.pi))
    return deviation**2 / share


def _noise_transfer(wave_number: Array, grain_mm: float) -> Array:
    """Return the share of the amplitude of noise that reaches the surface through its grid and smoothing."""
    return np.asarray(np.exp(-0.5 * (grain_mm * wave_number) ** 2))


def height_covariance(
    frame: tuple[Array, Array], centres: Array, areas: Array, weight: Callable[[Array], Array]
) -> Array:
    """Return what height noise of density 1 mm4 inside the face adds: y, alpha and gamma, (6, 6), SI.

    Parameters
    ----------
    frame : (origin (3,), axes (3, 3))
        mm, scan coordinates.
    centres, areas : ndarray, (n, 3), (n,)
        Pieces of the face, mm and mm2.
    weight : callable
        Weights of the robust plane as a function of the distance in mm.
    """
    origin, axes = frame
    local = (centres - origin) @ axes
    influence = np.zeros((len(local), 6))
    influence[:, 1] = 1.0 / areas.sum()
    influence[:, [3, 5]] = _tilts(local, areas, weight)
    covariance = (influence * areas[:, None]).T @ influence
    return np.asarray(covariance * np.outer(_SI, _SI))


def boundary_covariance(
    frame: tuple[Array, Array],
    patch: Patch,
    areas: Array,
    centres: Array,
    density: float,
    angle_deg: float,
    sigma_mm: float,
    weight: Callable[[Array], Array],
    blur_and_grain_mm: tuple[float, float],
) -> Array:
    """Return what noise of the normals adds by moving the rim where the face ends, (6, 6), SI.

    Notes
    -----
    A normal that errs by e moves the rim by e / curvature. Errors of the normal across the rim have the
    line density ``density / 2 pi * integral of k^2 H(k)^2``, H the smoothing of the normals and the gain by
    which taking the blur back raises short waves.
    """
    k = np.linspace(-60.0 / sigma_mm, 60.0 / sigma_mm, 12001)
    blur_mm, grain_mm = blur_and_grain_mm
    low = step_response(k, sigma_mm)
    lifted = 1.0 + 2.0 * (blur_mm / sigma_mm) ** 2 * (1.0 - low)
    waves = k * low**2 * lifted * _noise_transfer(k, grain_mm)
    line_density = density / (2.0 * np.pi) * float(np.sum(waves**2) * (k[1] - k[0]))
    influence, length = rim_influence(frame, patch, areas, centres, angle_deg, weight)
    influence = influence / rim_curvature(patch, angle_deg)[:, None]
    covariance = line_density * (influence * length[:, None]).T @ influence
    return np.asarray(covariance * np.outer(_SI, _SI))


def rim_curvature(patch: Patch, angle_deg: float) -> Array:
    """Return how fast the normal turns across each piece of the rim, (s,), 1/mm."""
    return np.asarray(np.maximum(patch.segment_slope / np.sin(np.radians(angle_deg)), 0.2))


def rim_influence(
    frame: tuple[Array, Array],
    patch: Patch,
    areas: Array,
    centres: Array,
    angle_deg: float,
    weight: Callable[[Array], Array],
) -> tuple[Array, Array]:
    """Return what an outward shift of the rim does to the frame per length, (s, 6), and lengths (s,), mm."""
    origin, axes = frame
    middle = (patch.segments.mean(axis=1) - origin) @ axes
    length = np.linalg.norm(patch.segments[:, 1] - patch.segments[:, 0], axis=1)
    local = (centres - origin) @ axes
    total = areas.sum()
    influence = np.zeros((len(middle), 6))
    influence[:, :3] = middle / total
    influence[:, [3, 5]] = _tilts(local, areas, weight, middle) * middle[:, 1:2]
    spread = areas @ (local[:, 0] ** 2 - local[:, 2] ** 2)
    influence[:, 4] = -middle[:, 0] * middle[:, 2] * np.cos(np.radians(angle_deg)) / max(spread, 1e-6)
    return influence, length


def edge_covariance(
    frame: tuple[Array, Array],
    patch: Patch,
    areas: Array,
    centres: Array,
    angle_deg: float,
    weight: Callable[[Array], Array],
    blur_mm: float,
    edge_mm: float,
) -> Array:
    """Return what blur and grid leave at the rim, whose curvature is not small, (6, 6), SI.

    Parameters
    ----------
    frame, patch, areas, centres, angle_deg, weight
        As in `boundary_covariance`.
    blur_mm : float
    edge_mm : float
        Length of the edges of the triangles.

    Notes
    -----
    Blur b moves an edge of radius R inward by b^2 / 2R + b^4 / 8R^3, of which the first term was restored.
    Chords of length h lie up to h^2 / 8R within it, h^2 / 27R in the standard deviation over places; edges of
    triangles are 0.7 grid spacings long. Both are taken as standard deviations common to a sector of
    the rim: shape of the edge and place on the grid change along it. The sectors are those of a circle that
    the face is stretched to: by angles on the face itself two of them would be its whole ends.
    """
    influence, length = rim_influence(frame, patch, areas, centres, angle_deg, weight)
    curvature = np.minimum(rim_curvature(patch, angle_deg), 1.0 / blur_mm)
    shift = np.hypot(blur_mm**4 * curvature**3 / 8.0, (edge_mm / 0.7) ** 2 * curvature / 27.0)
    steps = influence * (shift * length)[:, None]
    origin, axes = frame
    middle = (patch.segments.mean(axis=1) - origin) @ axes
    length_mm, width_mm = np.ptp(middle[:, [0, 2]], axis=0)
    angle = np.arctan2(middle[:, 2] / width_mm, middle[:, 0] / length_mm)
    sector = np.floor(angle / (2.0 * np.pi) * _SECTORS).astype(int) % _SECTORS
    parts = np.array([steps[sector == k].sum(axis=0) for k in range(_SECTORS)])
    return np.asarray(parts.T @ parts * np.outer(_SI, _SI))


def _tilts(local: Array, areas: Array, weight: Callable[[Array], Array], at: Array | None = None) -> Array:
    """Return the tilts (alpha, gamma) per area and per height error at points (n, 3), rad/mm3.

    The robust plane y = a + b x + c z has b = gamma and c = -alpha for small tilts.
    """
    offset = np.median(local[:, 1])
    weights = areas * weight(local[:, 1] - offset)
    design = np.column_stack([np.ones(len(local)), local[:, 0], local[:, 2]])
    inverse = np.linalg.inv((design * weights[:, None]).T @ design)
    points = local if at is None else at
    rows = np.column_stack([np.ones(len(points)), points[:, 0], points[:, 2]])
    share = (rows @ inverse) * weight(points[:, 1] - offset)[:, None]
    return np.column_stack([-share[:, 2], share[:, 1]])
