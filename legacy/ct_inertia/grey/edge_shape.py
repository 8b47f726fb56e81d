"""Test on edges of bone whether the point spread is an isotropic Gaussian: their widths and their shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.grey.edge_departure import (
    PLACES,
    Profiles,
    cells_of,
    long_tails,
    sharpening,
    skewness,
    sums,
)
from legacy.ct_inertia.grey.psf import Candidates, candidate_edges, tangents
from legacy.ct_inertia.volume.distance import capped_distance
from legacy.ct_inertia.volume.grid_operations import gaussian, interpolated
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

# Edges that are looked at, and the least that must be clean.
_MOST, _LEAST = 12_000, 120
# Edges that must face every direction for widths to be compared, and flat ones for bent ones to be left out.
_LEAST_FACING, _FLAT_FACING = 30.0, 300.0
# Rounds of the fit of widths, and medians of the residual from which on an edge is an outlier.
_ROUNDS, _OUTLIER = 6, 3.0
# Width of the cells in which neighbouring edges, which share noise and curvature, count once: six widths of
# the blur, beyond which two edges share no voxel.
_CELL_WIDTHS = 6.0
# Widths of an edge between it and another body, whose own tail is below 0.0013 there.
_CLEAR_WIDTHS = 3.0
# Grey value beyond the tails of an edge, as a share of the contrast, above which it is no edge in air: a
# fifth of that of mucosa (15 %). Chosen by judgement.
_LEAST_MEDIUM = 0.03
# Probability with which an even point spread is called uneven; its deviation from even has five freedoms.
_FALSE_ALARMS, _UNEVEN_FREEDOMS = 1e-3, 5
# Scheffe's limit with infinitely many cells, the root of chi2's quantile with the numbers above: below it
# nothing is uneven, and scipy.stats, slow to import, is not asked.
_LEAST_UNEVEN = 4.529
_WIDTH_MODEL_SD = calibrated("edges.width_model_sd")
# Noise that is added where edges are sought, as a share of the scan's own: little, for they shall be found.
_ADDED = 0.5
# Width of a Gaussian, in voxels, below which noise smoothed by it is white.
_LEAST_CORRELATED = 0.3


@dataclass(frozen=True)
class EdgeShape:
    """What the edges show of the point spread.

    Attributes
    ----------
    covariance_mm2 : ndarray, (3, 3)
        Of the point spread, along x, y, z.
    uneven : bool
        Its principal widths differ significantly.
    sharpening_mm2 : float
        f of the operator 1 - f Laplacian that explains air darker and bone brighter next to the surface; 0
        where they are not significant.
    overshoot : float
        Largest departure from a blurred step outside the surface, as a share of the contrast.
    levels : (air, bone)
        Grey values of which ``edges`` are shares.
    edges : Profiles
    independent : callable
        Returns profiles of edges that were found in noise which is not theirs; None with too few.
    """

    covariance_mm2: Array
    uneven: bool
    sharpening_mm2: float
    overshoot: float
    levels: tuple[float, float]
    edges: Profiles
    independent: Callable[[], Profiles | None]

    def departures(self, air: float, bone_at: Callable[[Array], Array], bone_sd: float) -> tuple[float, bool]:
        """Return `edge_departure.skewness`, and whether edges have long tails: something soft on the bone.

        Both are those between air and the level (n,) of bone at the edges (n, 3).
        """

        @cache
        def rescaled(again: bool) -> Profiles | None:
            found = self.independent() if again else self.edges
            return None if found is None else found.between(self.levels, air, bone_at(found.points_mm))

        share_sd = bone_sd / (self.levels[1] - self.levels[0])
        skewed = skewness(lambda: rescaled(False), lambda: rescaled(True), share_sd)
        return skewed, long_tails(rescaled(False), share_sd)


def uneven_notice(shape: EdgeShape) -> Notice:
    """Name the direction of the widest blur."""
    widths, axes = np.linalg.eigh(shape.covariance_mm2)
    along = axes[:, -1] * np.sign(axes[np.argmax(np.abs(axes[:, -1])), -1])
    listed = ", ".join(f"{v:.2f}" for v in along)
    text = (
        f"The scan is blurred unevenly: {1e3 * np.sqrt(widths[-1]):.0f} um along ({listed}) in x, y, z of "
        f"the voxels, {1e3 * np.sqrt(widths[0]):.0f} um across. The sample moved or settled during the scan, "
        f"or the reconstruction (centre of rotation, interpolation) smears that direction. The other "
        f"directions were blurred as much before measuring. Check the reconstruction; fix the sample."
    )
    return Notice("blur_uneven", text)


def fringe_notice(overshoot: float, sharpening_mm2: float) -> Notice:
    """Name overshoot at edges, a share of the contrast, and what was done about it."""
    text = (
        f"Air right at the bone is darker, and bone brighter, than blur explains, by {100.0 * overshoot:.1f} "
        f"% of the contrast of bone and air: phase contrast (fringes at edges), or a sharpening filter of "
        f"the reconstruction. It was undone before measuring (phase retrieval with a length of "
        f"{1e3 * np.sqrt(sharpening_mm2):.0f} um), and the budget holds what may remain (levels). "
        f"Reconstruct with phase retrieval or without sharpening."
    )
    return Notice("phase_fringes", text)


def edge_shape(
    grey: NDArray[np.float32],
    near_edge: NDArray[np.bool_],
    foreign: NDArray[np.bool_],
    levels: tuple[float, float],
    spacing_mm: Array,
    noise: float = 0.0,
    shared_sd: float = 0.0,
    correlation: float = 1.0,
) -> EdgeShape | None:
    """Measure the covariance of the point spread, and whether edges overshoot; None with too few edges.

    Parameters
    ----------
    grey : ndarray of float32, [z, y, x]
    near_edge : ndarray of bool, [z, y, x]
        Where to look.
    foreign : ndarray of bool, [z, y, x]
        Other bodies, from which edges must be clear.
    levels : (air, bone)
    spacing_mm : ndarray, (3,)
    noise : float
        Standard deviation of a voxel, as a share of bone minus air.
    shared_sd : float
        Standard deviation of an error of the grey values that all edges share, as a share of bone minus air:
        what coarse steps leave between two of them.
    correlation : float
        Variance of sums of noise over that of white noise.

    Notes
    -----
    Across a face of normal n a Gaussian of covariance C has the variance n C n: weighted least squares over
    clean edges, whose reach is that of their own direction. Standard deviations are those between cells.
    Along the normal a Gaussian leaves Phi(t); a fourth cumulant k adds -k / 24 He3(t) phi(t) (Edgeworth).
    1 - f Laplacian, which propagation adds to the image of one material (Paganin et al. 2002,
    doi:10.1046/j.1365-2818.2002.01010.x) and sharpening filters add by design, leaves
    Phi(u) + f / B^2 u phi(u), u = t / B.

    Place and normal of an edge come from the voxels across it, so that its profile follows their noise: air
    is darker and bone brighter beside it, the more the louder it is. Where that may be what is seen, edges
    are sought in grey values with more noise a w, and looked at in those less w / a: n + a w and n - w / a
    are independent of each other where w is like the scan's own noise n.
    """
    region = _Region(near_edge, foreign, levels, spacing_mm)
    seen = _profiles(grey, grey, region, noise)
    if seen is None:
        return None

    @cache
    def independent() -> Profiles | None:
        """Return profiles of edges that were found in other noise; the same ones without noise."""
        if not noise:
            return seen.as_shares(shared_sd)
        more = np.float32(_ADDED) * _like_noise(grey.shape, levels, noise, correlation)
        less = more / np.float32(_ADDED**2)
        pairs = ((grey + sign * more, grey - sign * less) for sign in (np.float32(1.0), np.float32(-1.0)))
        halves = [_profiles(*pair, region, float(np.hypot(1.0, _ADDED)) * noise) for pair in pairs]
        found = [half for half in halves if half is not None]
        return _join_profiles(found).as_shares(shared_sd) if found else None

    shares = seen.as_shares(shared_sd)
    strength, overshoot = sharpening(shares)
    if strength and noise:
        again = independent()
        strength, overshoot = (0.0, 0.0) if again is None else sharpening(again)
    return EdgeShape(
        np.ascontiguousarray(seen.covariance_mm2[::-1, ::-1]),
        seen.uneven,
        strength * seen.sigma_mm**2,
        overshoot,
        levels,
        shares,
        independent,
    )


@dataclass(frozen=True)
class _Region:
    """Where edges are looked for, as the parameters of ``edge_shape``."""

    near_edge: NDArray[np.bool_]
    foreign: NDArray[np.bool_]
    levels: tuple[float, float]
    spacing_mm: Array


@dataclass(frozen=True)
class _Profiles:
    """Shares across each clean edge (n, places), its place z, y, x (n, 3), mm, and the blur of all.

    ``cell_mm`` is the edge of cells that share noise and curvature, ``covariance_mm2`` (3, 3) along z, y, x,
    and whether it is ``uneven``; ``sigma_mm`` its median width.
    """

    values: Array
    places_mm: Array
    cell_mm: float
    covariance_mm2: Array
    uneven: bool
    sigma_mm: float

    def as_shares(self, shared_sd: float) -> Profiles:
        """Return the shares with the cells of their edges."""
        cells = cells_of(self.places_mm, self.cell_mm)
        return Profiles(self.values, cells, self.places_mm[:, ::-1], shared_sd)


def _like_noise(
    shape: tuple[int, ...], levels: tuple[float, float], noise: float, correlation: float
) -> NDArray[np.float32]:
    """Return noise [z, y, x] of that share of the contrast, smoothed by a Gaussian to that correlation."""
    like = np.random.default_rng(0).standard_normal(shape, dtype=np.float32)
    width = float(np.cbrt(correlation)) / (2.0 * np.sqrt(np.pi))
    if width > _LEAST_CORRELATED:
        like = gaussian(like, width)
        like /= np.float32(like.std(dtype=float))
    like *= np.float32(noise * (levels[1] - levels[0]))
    return like


def _join_profiles(parts: list[_Profiles]) -> _Profiles:
    values = np.concatenate([part.values for part in parts])
    return replace(parts[0], values=values, places_mm=np.concatenate([part.places_mm for part in parts]))


def _profiles(
    grey: NDArray[np.float32], looked_at: NDArray[np.float32], region: _Region, noise: float
) -> _Profiles | None:
    """Find the clean edges of grey values in a region, and profiles of others across them; None: too few."""
    (air, bone), spacing_mm = region.levels, region.spacing_mm
    edges = candidate_edges(grey, region.near_edge, region.levels, spacing_mm, noise, 0, _MOST)
    if edges is None:
        return None

    def share_at(points_mm: Array, of: NDArray[np.float32] = grey) -> Array:
        return np.asarray((interpolated(of, points_mm / edges.spacing_mm) - air) / (bone - air))

    far = _CLEAR_WIDTHS * float(np.median(edges.total_mm))
    blocked = capped_distance(region.foreign, spacing_mm, far) < far
    calm = gaussian(grey, 1.0, truncate=3.0)
    most = air + max(_LEAST_MEDIUM, noise) * (bone - air)
    clean = np.ones(len(edges.total_mm), dtype=bool)
    for _ in range(2):
        fitted = _fit_covariance(edges, clean)
        if fitted is None:
            return None
        width = np.sqrt(np.maximum(_squares(edges.inward) @ fitted.values, (1.04 * edges.smoothing_mm) ** 2))
        foot = edges.places_mm - (edges.quantile * width)[:, None] * edges.inward

        def across(t: float, foot: Array = foot, width: Array = width) -> Array:
            return foot + (t * width)[:, None] * edges.inward

        slack = max(0.15, 2.5 * noise)
        clean = np.abs(share_at(across(-2.6))) < slack
        for t in (2.6, 3.6):
            clean &= np.abs(share_at(across(t)) - 1.0) < slack
        for t in (-2.0, -4.4):
            index = np.rint(across(t) / edges.spacing_mm).astype(np.int64)
            index = np.clip(index, 0, np.array(grey.shape) - 1)
            clean &= ~blocked[tuple(index.T)]
        # Beyond the tails of bone and of a thin coat lies air, or the edge is one in fluid.
        clean &= calm[tuple(index.T)] < most
        bent = np.zeros(len(foot))
        for tangent in tangents(edges.inward):
            beside = [share_at(foot + sign * 2.5 * width[:, None] * tangent) for sign in (-1.0, 1.0)]
            bent = np.maximum(bent, np.abs(0.5 * (beside[0] + beside[1]) - 0.5))
        flat = clean & (bent < max(0.1, 1.2 * noise))
        clean = flat if _count_fewest_normals(edges.inward[flat]) >= _FLAT_FACING else clean
        if np.count_nonzero(clean) < _LEAST:
            return None
    fitted = _fit_covariance(edges, clean)
    if fitted is None:
        return None
    covariance = fitted.matrix() - edges.smoothing_mm**2 * np.eye(3)
    least = (0.3 * edges.smoothing_mm) ** 2
    size, axes = np.linalg.eigh(covariance)
    covariance = (axes * np.maximum(size, least)) @ axes.T
    sigma = np.sqrt(np.maximum(width**2 - edges.smoothing_mm**2, least))[clean]
    offsets = (PLACES[:, None] * sigma)[..., None] * edges.inward[clean]
    values = np.stack([share_at(foot[clean] + step, looked_at) for step in offsets], axis=1)
    return _Profiles(
        values,
        foot[clean],
        _CELL_WIDTHS * float(np.median(width)),
        covariance,
        _count_fewest_normals(edges.inward[clean]) >= _LEAST_FACING and fitted.uneven(edges.smoothing_mm),
        float(np.median(sigma)),
    )


@dataclass(frozen=True)
class _Fit:
    """Variances along z, y, x, covariances zy, zx, yx (6,), their covariance (6, 6); number of cells."""

    values: Array
    covariance: Array
    cells: int

    def matrix(self) -> Array:
        a, b, c, d, e, f = self.values
        return np.array([[a, d, e], [d, b, f], [e, f, c]])

    def uneven(self, smoothing_mm: float) -> bool:
        """Return whether the largest and the smallest principal variance differ significantly.

        Notes
        -----
        Their directions are those of the largest difference: Scheffe's limit (1953, Biometrika 40:87) holds
        for all contrasts of a tensor at once.
        """
        size, axes = np.linalg.eigh(self.matrix() - smoothing_mm**2 * np.eye(3))
        step = (_squares(axes[:, 2:].T) - _squares(axes[:, :1].T))[0]
        model = _WIDTH_MODEL_SD * float(np.mean(size))
        sd = float(np.sqrt(max(step @ self.covariance @ step, 0.0) + model**2))
        if size[2] - size[0] <= _LEAST_UNEVEN * sd:
            return False
        from scipy.special import fdtri  # a quarter of a second

        freedom = max(self.cells - len(self.values), 1)
        limit = np.sqrt(_UNEVEN_FREEDOMS * fdtri(_UNEVEN_FREEDOMS, freedom, 1.0 - _FALSE_ALARMS))
        return bool(size[2] - size[0] > limit * sd)


def _fit_covariance(edges: Candidates, used: NDArray[np.bool_]) -> _Fit | None:
    design, seen = _squares(edges.inward[used]), edges.total_mm[used] ** 2
    good = np.ones(len(seen), dtype=bool)
    for _ in range(_ROUNDS):
        normal = design[good].T @ design[good]
        if np.linalg.cond(normal) > 1e6:
            return None
        values = np.linalg.solve(normal, design[good].T @ seen[good])
        left = seen - design @ values
        good = np.abs(left) < _OUTLIER * float(np.median(np.abs(left)))
    cells = cells_of(edges.places_mm[used][good], _CELL_WIDTHS * float(np.median(edges.total_mm)))
    scores = sums(design[good] * left[good][:, None], cells)
    inverse = np.linalg.inv(normal)
    covariance = np.asarray(inverse @ (scores.T @ scores) @ inverse, dtype=np.float64)
    return _Fit(np.asarray(values, dtype=np.float64), covariance, len(scores))


def _count_fewest_normals(normals: Array) -> float:
    """Return the number of normals (n, 3) along the direction that has fewest of them."""
    return float(np.linalg.eigvalsh(normals.T @ normals)[0])


def _squares(normals: Array) -> Array:
    """Return the factors (n, 6) of zz, yy, xx, zy, zx, yx in n C n."""
    z, y, x = normals.T
    return np.column_stack([z * z, y * y, x * x, 2.0 * z * y, 2.0 * z * x, 2.0 * y * x])
