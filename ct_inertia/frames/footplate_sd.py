"""The covariance of the footplate frame from errors of the surface, by influence functions.

A small outward height h(r) of the medial face moves the frame by the integral of an influence function a(r)
h(r): its mean height and the slopes of the robust plane. A normal that errs by e across the rim moves the
place where the face ends by e / curvature, which adds or takes off area there: influence b(s) along the
rim. That a turn of y moves the rim, too, adds about a tenth to turns and is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ct_inertia.calibrated import calibrated
from ct_inertia.frames.footplate_face import FACE_ANGLE_DEG, NORMAL_SCALE_MM, Solved, plane_weights, solve
from ct_inertia.surface.fields import step_response, unit
from stapeskit.arrays import Array
from stapeskit.frames import vector_from_rotation

_SI = np.array([1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0])
_SECTORS = 12  # of the rim: each some tenths of a millimetre long
_LEAST_CURVATURE = 0.2  # 1/mm: a rim that bends less is none
_ROUGH = 3e-5  # rad: accuracy of solutions that are only compared, far below the differences that count
_MOST_STEP_DEG = 0.1 * FACE_ANGLE_DEG  # further the difference of two solutions is no derivative
_RIM_DEG_PER_MM = calibrated("footplate.rim_deg_per_mm")
_FITTED_RIM_DEG_PER_MM = calibrated("footplate.fitted_rim_deg_per_mm")
_SHAPE_LEFT = np.array(calibrated("footplate.shape_left"))
_EDGE_LEFT = calibrated("footplate.edge_left")
_LONG_AXIS_LEFT_RAD = calibrated("footplate.long_axis_left_rad")
_RIM_NOISE = calibrated("footplate.rim_noise") ** 2
_GRAIN = calibrated("footplate.grain")
_BLUR_SHIFT_1_MM = calibrated("footplate.unknown_blur_shift_1_mm")
_BLUR_TILT_RAD_MM2 = calibrated("footplate.unknown_blur_tilt_rad_mm2")
_MOST_BLUR_MM = 0.04  # resolution up to which an unknown blur grows with it


@dataclass(frozen=True)
class SurfaceError:
    """How a surface errs.

    Attributes
    ----------
    fitted : bool
        The body was fitted to grey values or voxels; otherwise it is a mesh of unknown origin.
    blur_mm : float
        Blur that is left in it and is taken back, standard deviation.
    spread_mm2 : ndarray, (3, 3), or None
        Covariance, in scan axes, of what edges are seen through; None: the triangles.
    noise_mm4, correlation_mm : float
        Spectral density of its height noise at long waves, and the length over which that is common.
    misfit_sd_mm : callable or None
        Standard deviation of the height at scan points (n, 3), common over ``misfit_mm``.
    misfit_mm : float
    level_sd_mm : float
        Of one shift of the whole surface along its normal.
    """

    fitted: bool = False
    blur_mm: float = 0.0
    spread_mm2: Array | None = None
    noise_mm4: float = 0.0
    correlation_mm: float = 0.0
    misfit_sd_mm: Callable[[Array], Array] | None = None
    misfit_mm: float = 0.0
    level_sd_mm: float = 0.0

    @property
    def resolution_mm(self) -> float:
        """Width of what edges are seen through, root mean square of its directions; 0: the triangles."""
        return 0.0 if self.spread_mm2 is None else float(np.sqrt(np.trace(self.spread_mm2) / 3.0))


EXACT = SurfaceError()
"""A mesh of which nothing is known but its triangles."""


def contributions_of(solved: Solved, error: SurfaceError) -> dict[str, Array]:
    """Return the covariance of the frame by source, (6, 6) each, SI.

    Notes
    -----
    Where a blur left edges unknown, what a step of the angle or of the scale of the normals does shows how
    sensitive this shape is to them.
    """
    region = solved.region
    resolution = error.resolution_mm or region.edge_mm
    influence = Influence(solved)
    density, correlation = error.noise_mm4, error.correlation_mm
    if not error.fitted:
        correlation = float(np.sqrt(2.0)) * _GRAIN * resolution
        density += shown_noise(solved, correlation)
    slopes = influence.rim(_slope_density(density, correlation, error))
    heights = influence.rim_heights(_height_density(density, correlation))
    parts = {"noise": density * influence.white_heights() + _RIM_NOISE * (slopes + heights)}
    if error.misfit_sd_mm is not None:
        parts["misfit"] = influence.common_heights(error.misfit_sd_mm, error.misfit_mm)
        parts["misfit"] = parts["misfit"] + influence.sectors(error.misfit_sd_mm(influence.middles))
    if error.level_sd_mm:
        parts["levels"] = np.diag(np.square([0.0, 1e-3 * error.level_sd_mm, 0.0, 0.0, 0.0, 0.0]))
    if error.fitted:
        spread = resolution**2 * np.eye(3) if error.spread_mm2 is None else error.spread_mm2
        across = np.einsum("si,ij,sj->s", influence.outward, spread, influence.outward)
        curvature = np.minimum(influence.curvature, 1.0 / np.sqrt(across))
        parts["edges"] = influence.sectors(_EDGE_LEFT * across * curvature)
    scale = _SHAPE_LEFT if error.fitted else np.ones(6)
    per_mm = _FITTED_RIM_DEG_PER_MM if error.fitted else _RIM_DEG_PER_MM
    step_deg = min(per_mm * resolution, _MOST_STEP_DEG)
    y_axis = solved.axes[:, 1]
    wider, narrower = (
        solve(region, y_axis, FACE_ANGLE_DEG + sign * step_deg, accuracy=_ROUGH) for sign in (1, -1)
    )
    rim = scale * 0.5 * _displacement(narrower, wider, solved)
    smoother = solve(region, y_axis, normals=region.smoother, accuracy=_ROUGH)
    wanting = min(2.0 * (resolution / NORMAL_SCALE_MM) ** 2, 4.0)
    shape = scale * wanting * _displacement(solved, smoother, solved)
    parts |= {"rim": np.outer(rim, rim), "resolution": np.outer(shape, shape)}
    if error.fitted:
        parts["rim"][4, 4] += (_LONG_AXIS_LEFT_RAD * influence.roundness) ** 2
    else:
        parts["blur"] = _unknown_blur(resolution)
    return parts


class Influence:
    """What small errors of a surface do to the frame found on it, to first order.

    Parameters
    ----------
    solved : Solved

    Attributes
    ----------
    points : ndarray, (k, 3)
        Centres of the triangles of the face, scan coordinates, mm.
    heights : ndarray, (k, 6)
        Change of (x, y, z in mm, alpha, beta, gamma in rad) per mm of outward height and mm2, at the
        triangles.
    rims : ndarray, (s, 6)
        The same per mm of outward shift of the rim and mm of its length, at the pieces of the border.
    lengths, curvature : ndarray, (s,)
        Of the pieces of the border: length, mm, and how fast the normal turns across it, 1/mm.
    outward : ndarray, (s, 3)
        Normals of the surface there, scan axes.
    flat : ndarray, (s, 2)
        Their places x, z in footplate axes, mm.
    roundness : float
        Sum over difference of the second moments along x and z: how far a nearly round outline turns.
    """

    def __init__(self, solved: Solved) -> None:
        face, axes = solved.face, solved.axes
        self.areas = face.areas
        self.points = face.centres + solved.region.middle
        local = (face.centres - face.centroid) @ axes
        self.heights = np.zeros((len(local), 6))
        self.heights[:, 1] = -1.0 / self.areas.sum()  # outward is along -y
        self.heights[:, [3, 5]] = -_tilts(local, self.areas)
        middle = (face.segments.mean(axis=1) - face.centroid) @ axes
        self.lengths = np.linalg.norm(face.segments[:, 1] - face.segments[:, 0], axis=1)
        self.middles = face.segments.mean(axis=1) + solved.region.middle
        self.flat = middle[:, [0, 2]]
        self.rims = np.zeros((len(middle), 6))
        self.rims[:, :3] = middle / self.areas.sum()
        self.rims[:, [3, 5]] = _tilts(local, self.areas, middle) * middle[:, 1:2]
        spread = max(float(self.areas @ (local[:, 0] ** 2 - local[:, 2] ** 2)), 1e-6)
        self.roundness = float(self.areas @ (local[:, 0] ** 2 + local[:, 2] ** 2)) / spread
        cosine = float(np.cos(np.radians(FACE_ANGLE_DEG)))
        self.rims[:, 4] = -middle[:, 0] * middle[:, 2] * cosine / spread
        sine = float(np.sin(np.radians(FACE_ANGLE_DEG)))
        along = (face.segments[:, 1] - face.segments[:, 0]) @ axes
        beyond = np.column_stack([along[:, 2], np.zeros(len(along)), -along[:, 0]])
        beyond *= np.sign(np.sum(beyond * middle, axis=1, keepdims=True))
        self.outward = (sine * unit(beyond) - cosine * np.eye(3)[1]) @ axes.T
        self.curvature = np.maximum(face.slopes / sine, _LEAST_CURVATURE)

    def white_heights(self) -> Array:
        """Return what height noise of density 1 mm4 inside the face adds, (6, 6), SI."""
        return _to_si((self.heights * self.areas[:, None]).T @ self.heights)

    def rim(self, slope_density: float | Array) -> Array:
        """Return what errors of the normal across the rim add, (6, 6), SI, by their line density, rad2 mm."""
        moved = self.rims / self.curvature[:, None]
        return _to_si((moved * (self.lengths * slope_density)[:, None]).T @ moved)

    def rim_heights(self, height_density: float) -> Array:
        """Return what heights of the rim, which move it outward, add, (6, 6), SI, by line density, mm3."""
        sine = float(np.sin(np.radians(FACE_ANGLE_DEG)))
        return _to_si((self.rims * (self.lengths * height_density)[:, None]).T @ self.rims) * sine**2

    def sectors(self, shift_mm: Array) -> Array:
        """Return what shifts of the rim (s,), mm, that are common to a sector of it add, (6, 6), SI.

        Notes
        -----
        Shape of the edge and place on the grid change along the rim. The sectors are those of a circle that
        the face is stretched to: by angles on the face itself two of them would be its whole ends.
        """
        steps = self.rims * (shift_mm * self.lengths)[:, None]
        along, across = self.flat.T
        angle = np.arctan2(across / np.ptp(across), along / np.ptp(along))
        sector = np.floor(angle / (2.0 * np.pi) * _SECTORS).astype(int) % _SECTORS
        parts = np.array([steps[sector == k].sum(axis=0) for k in range(_SECTORS)])
        return _to_si(parts.T @ parts)

    def common_heights(self, sd_mm: Callable[[Array], Array], length_mm: float) -> Array:
        """Return the covariance (6, 6), SI, by common errors of height that depend on the place.

        Notes
        -----
        Errors that are white noise averaged over a Gaussian of width L have the correlation exp(-r^2 / 4
        L^2): density 4 pi L^2 sd^2, no more than all of the face together; and slopes across a line of the
        density sqrt(pi) sd^2 / L.
        """
        density = min(4.0 * np.pi * length_mm**2, float(self.areas.sum()))
        inside = self.heights * (sd_mm(self.points) * np.sqrt(density * self.areas))[:, None]
        along = float(np.sqrt(np.pi)) / length_mm * sd_mm(self.middles) ** 2
        return _to_si(inside.T @ inside) + self.rim(along)


def _to_si(covariance: Array) -> Array:
    return np.asarray(covariance * np.outer(_SI, _SI))


def _tilts(local: Array, areas: Array, at: Array | None = None) -> Array:
    """Return the tilts (alpha, gamma) per area and height error along +y at points (n, 3), rad/mm3.

    The robust plane y = a + b x + c z has b = gamma and c = -alpha for small tilts.
    """
    offset = np.median(local[:, 1])
    weights = areas * plane_weights(local[:, 1] - offset)
    design = np.column_stack([np.ones(len(local)), local[:, 0], local[:, 2]])
    inverse = np.linalg.inv((design * weights[:, None]).T @ design)
    points = local if at is None else at
    rows = np.column_stack([np.ones(len(points)), points[:, 0], points[:, 2]])
    share = (rows @ inverse) * plane_weights(points[:, 1] - offset)[:, None]
    return np.column_stack([-share[:, 2], share[:, 1]])


def _slope_density(density: float, correlation_mm: float, error: SurfaceError) -> float:
    """Return the line density, rad2 mm, of errors of the diffused normals across the rim by height noise.

    Notes
    -----
    1 / 2 pi times the integral of density k^2 H(k)^2, H the two steps of diffusion, the averaging that made
    the noise common over a length (exp(-k^2 l^2 / 4)), and the gain by which taking a blur back raises
    short waves.
    """
    k = np.linspace(-60.0 / NORMAL_SCALE_MM, 60.0 / NORMAL_SCALE_MM, 12001)
    low = step_response(k, NORMAL_SCALE_MM)
    lifted = 1.0 + 2.0 * (error.blur_mm / NORMAL_SCALE_MM) ** 2 * (1.0 - low)
    waves = k * low**2 * lifted * np.exp(-0.25 * (correlation_mm * k) ** 2)
    return density / (2.0 * np.pi) * float(np.sum(waves**2) * (k[1] - k[0]))


def _height_density(density: float, correlation_mm: float) -> float:
    """Return the line density, mm3, along the rim of height noise that is averaged over a length."""
    k = np.linspace(-60.0 / NORMAL_SCALE_MM, 60.0 / NORMAL_SCALE_MM, 12001)
    waves = step_response(k, NORMAL_SCALE_MM) ** 2 * np.exp(-0.25 * (correlation_mm * k) ** 2)
    return density / (2.0 * np.pi) * float(np.sum(waves**2) * (k[1] - k[0]))


def shown_noise(solved: Solved, correlation_mm: float) -> float:
    """Estimate the spectral density of a mesh's height noise from its face, mm4.

    Notes
    -----
    From the second difference of the heights after one, two and three steps of diffusion, a band where
    noise is larger than the curvature of bone, robustly (median absolute deviation) over the face.
    """
    region = solved.region
    facing = -(region.normals @ solved.axes[:, 1]) > np.cos(np.radians(FACE_ANGLE_DEG))
    once = region.diffusion.step(region.diffusion.points)
    twice = region.diffusion.step(once)
    waves = once - 2.0 * twice + region.diffusion.step(twice)
    height = np.einsum("ij,ij->i", waves[facing], region.normals[facing])
    deviation = 1.4826 * float(np.median(np.abs(height - np.median(height)))) if len(height) else 0.0
    k = np.linspace(0.0, 60.0 / NORMAL_SCALE_MM, 6001)
    low = step_response(k, NORMAL_SCALE_MM)
    band = low * (1.0 - low) ** 2 * np.exp(-0.25 * (correlation_mm * k) ** 2)
    return deviation**2 / (float(np.sum(k * band**2) * (k[1] - k[0])) / (2.0 * np.pi))


def _unknown_blur(resolution_mm: float) -> Array:
    """Return the covariance (6, 6), SI, from an unknown point spread: it shifts and tilts the curved face."""
    square = min(resolution_mm, _MOST_BLUR_MM) ** 2
    shift, tilt = _BLUR_SHIFT_1_MM * square * 1e-3, _BLUR_TILT_RAD_MM2 * square
    return np.diag([0.0, shift**2, 0.0, tilt**2, 0.0, tilt**2])


def _displacement(start: Solved, end: Solved, frame: Solved) -> Array:
    """Return the small motion (6,) from one solution to another, in the axes of ``frame``, m and rad."""
    turned = end.axes * np.sign(np.sum(end.axes * start.axes, axis=0))
    rotation = vector_from_rotation(turned @ start.axes.T)
    shift = (end.origin - start.origin) * 1e-3
    return np.concatenate([frame.axes.T @ shift, frame.axes.T @ rotation])
