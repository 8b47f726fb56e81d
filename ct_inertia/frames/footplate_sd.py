"""The covariance of the footplate frame from errors of the surface, by influence functions.

A small outward height h(r) of the medial face moves the frame by the integral of an influence function a(r)
h(r): its mean height and the slopes of the robust plane. A normal that errs by e across the rim moves the
place where the face ends by e / curvature, which adds or takes off area there: influence b(s) along the
rim. That a turn of y moves the rim, too, adds about a tenth to turns and is left out.
"""

from __future__ import annotations

import numpy as np

from ct_inertia.bodies import BodySurface
from ct_inertia.calibrated import calibrated
from ct_inertia.frames.footplate_face import (
    EDGE_MM,
    FACE_ANGLE_DEG,
    NORMAL_SCALE_MM,
    Solved,
    plane_weights,
    solve,
)
from ct_inertia.surface.fields import unit
from stapeskit.arrays import Array
from stapeskit.frames import vector_from_rotation

_SI = np.array([1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0])
_COSINE = float(np.cos(np.radians(FACE_ANGLE_DEG)))
_SINE = float(np.sin(np.radians(FACE_ANGLE_DEG)))
_SECTORS, _SIDES = 12, 4  # of the rim: each some tenths of a millimetre long; its long sides and its ends
_LEAST_CURVATURE = 0.2  # 1/mm: a rim that bends less is none
_ALL_OF_BLUR = 0.5  # of its variance times the curvature of an edge: the shift of a blurred edge (Taylor)
_EDGE_LEFT = calibrated("footplate.edge_left")
_LONG_AXIS_LEFT_RAD = calibrated("footplate.long_axis_left_rad")
_TILT_LEFT = calibrated("footplate.tilt_left")
_HEIGHT_LEFT_MM = calibrated("footplate.height_left_mm")
_CUT_RADII = 1.5  # of a cut as a disc: it is longer than it is wide
_MESH_BLUR = calibrated("footplate.mesh_blur")


def contributions_of(solved: Solved, body: BodySurface | None) -> dict[str, Array]:
    """Return the covariance of the frame by source, (6, 6) each, SI.

    ``body``: how the surface errs; None: a mesh of which nothing is known but its triangles.

    Notes
    -----
    Edges that a blur of covariance C hides err by a share of n^T C n times their curvature, each part of the
    rim by itself; coarse slices blur one direction more, on whole sides of the rim. What one more step of
    diffusion changes shows how sensitive this shape is to its scale; bends of real bone that the scan does
    not show turn the plane either way, as much as that step does on average. Two tilts of one shape measure
    that badly: their variance is averaged with that of all shapes. A mesh of unknown origin may have been cut
    from a blurred picture: that blur is taken back as a trial.
    """
    region, y_axis = solved.region, solved.axes[:, 1]
    influence = Influence(solved)
    known = 0.0 if body is None else body.noise_mm4
    parts = {"noise": influence.noise(max(shown_noise(solved), known))}
    if body is None:
        blur = _MESH_BLUR * min(region.edge_mm, EDGE_MM)  # larger triangles are of a mesh that was thinned
        spread, left = blur**2 * np.eye(3), _ALL_OF_BLUR
        trial = _displacement(solved, solve(region.sharpened(blur), y_axis))
        parts["blur"] = np.outer(trial, trial)
    else:
        spread, left = body.spread_mm2, _EDGE_LEFT
        parts["levels"] = np.diag(np.square([0.0, 1e-3 * body.level_sd_mm, 0.0, 0.0, 0.0, 0.0]))
        if body.misfit_sd_mm.any():
            parts["misfit"] = influence.misfit(body)
        if body.cuts:
            parts["border"] = np.sum([influence.cut(*cut) for cut in body.cuts], axis=0)
    across = np.einsum("si,ij,sj->s", influence.outward, spread, influence.outward)
    curvature = np.minimum(influence.curvature, 1.0 / np.sqrt(across))
    even = float(np.linalg.eigvalsh(spread)[0])
    parts["edges"] = influence.sectors(left * even * curvature)
    parts["edges"] += influence.sectors(_ALL_OF_BLUR * (across - even) * curvature, _SIDES)
    parts["edges"][4, 4] += (_LONG_AXIS_LEFT_RAD * influence.roundness) ** 2
    smoother = solve(region, y_axis, unit(region.diffusion.step(region.normals)))
    wanting = 2.0 * float(np.trace(spread)) / 3.0 / NORMAL_SCALE_MM**2
    step = _displacement(solved, smoother)
    parts["resolution"] = wanting**2 * np.outer(step, step)
    extent = influence.extent[[2, 0]]
    heights = _TILT_LEFT**2 * wanting * float(np.mean(np.square(step[[3, 5]] * extent)))
    parts["resolution"][[3, 5], [3, 5]] += 0.5 * (heights + _HEIGHT_LEFT_MM**2) / extent**2
    return parts


class Influence:
    """What small errors of a surface do to the frame found on it, to first order.

    Attributes
    ----------
    points, middles : ndarray, (k, 3), (s, 3)
        Centres of the triangles of the face and of the pieces of its border, scan coordinates, mm.
    areas, lengths : ndarray, (k,), (s,)
        Of both, mm2 and mm.
    heights : ndarray, (k, 6)
        Change of (x, y, z in mm, alpha, beta, gamma in rad) per mm of outward height and mm2, at the
        triangles.
    rims : ndarray, (s, 6)
        The same per mm of outward shift of the rim and mm of its length, at the pieces of the border.
    curvature : ndarray, (s,)
        How fast the normal turns across the border, 1/mm.
    outward : ndarray, (s, 3)
        Normals of the surface there, scan axes.
    flat : ndarray, (s, 2)
        Their places x, z in footplate axes, mm.
    edge_mm : float
        Edges of the triangles.
    extent : ndarray, (3,)
        Root mean square of the places of the face about its centroid, footplate axes, mm.
    roundness : float
        Sum over difference of the second moments along x and z: how far a nearly round outline turns.
    """

    def __init__(self, solved: Solved) -> None:
        face, axes = solved.face, solved.axes
        self.areas, self.edge_mm = face.areas, min(solved.region.edge_mm, EDGE_MM)
        self.points = face.centres + solved.region.middle
        local = (face.centres - face.centroid) @ axes
        self.extent = np.sqrt(self.areas @ local**2 / self.areas.sum())
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
        self.rims[:, 4] = -middle[:, 0] * middle[:, 2] * _COSINE / spread
        along = (face.segments[:, 1] - face.segments[:, 0]) @ axes
        beyond = np.column_stack([along[:, 2], np.zeros(len(along)), -along[:, 0]])
        beyond *= np.sign(np.sum(beyond * middle, axis=1, keepdims=True))
        self.outward = (_SINE * unit(beyond) - _COSINE * np.eye(3)[1]) @ axes.T
        self.curvature = np.maximum(face.slopes / _SINE, _LEAST_CURVATURE)

    def noise(self, density: float) -> Array:
        """Return the covariance (6, 6), SI, by white noise of the height of a spectral density, mm4.

        Notes
        -----
        The rim is found on normals after two steps of diffusion, which multiply waves k by (1 + s^2 k^2 /
        4)^-2: along a line slopes then have the density S / (4 s^3), rad2 mm, and heights, which move the rim
        outward, 5 S / (16 s), mm3: 1 / 2 pi times the integrals of k^2 and of 1 times the square of that. The
        outline, which x follows, is one of the vertices themselves: heights of density S / edge.
        """
        scale = NORMAL_SCALE_MM
        inside = (self.heights * self.areas[:, None]).T @ self.heights
        shifts = density / (4.0 * scale**3) / self.curvature**2 + _SINE**2 * 5.0 * density / (16.0 * scale)
        covariance = _to_si(density * inside) + self._rim(shifts)
        raw = (_SINE / _COSINE) ** 2 * density / self.edge_mm
        covariance[4, 4] += self._rim(np.full(len(shifts), raw))[4, 4]
        return covariance

    def _rim(self, density: Array) -> Array:
        """Return what shifts of the rim of a line density (s,), mm3, add, (6, 6), SI."""
        return _to_si((self.rims * (self.lengths * density)[:, None]).T @ self.rims)

    def sectors(self, shift_mm: Array, count: int = _SECTORS) -> Array:
        """Return what shifts of the rim (s,), mm, that are common to a sector of it add, (6, 6), SI.

        Notes
        -----
        Shape of the edge and place on the grid change along the rim. The sectors are those of a circle that
        the face is stretched to: by angles on the face itself two of them would be its whole ends.
        """
        steps = self.rims * (shift_mm * self.lengths)[:, None]
        along, across = self.flat.T
        angle = np.arctan2(across / np.ptp(across), along / np.ptp(along))
        sector = np.floor(angle / (2.0 * np.pi) * count + 0.5).astype(int) % count
        parts = np.array([steps[sector == k].sum(axis=0) for k in range(count)])
        return _to_si(parts.T @ parts)

    def misfit(self, body: BodySurface) -> Array:
        """Return the covariance (6, 6), SI, by errors of height that depend on the place.

        Notes
        -----
        Errors that are white noise averaged over a Gaussian of width L have the correlation exp(-r^2 / 4
        L^2): density 4 pi L^2 sd^2, no more than all of the face together; and slopes across a line of the
        density sqrt(pi) sd^2 / L.
        """
        density = min(4.0 * np.pi * body.misfit_mm**2, float(self.areas.sum()))
        inside = self.heights * (body.misfit_at(self.points) * np.sqrt(density * self.areas))[:, None]
        at_rim = body.misfit_at(self.middles)
        slopes = float(np.sqrt(np.pi)) / body.misfit_mm * at_rim**2
        return _to_si(inside.T @ inside) + self._rim(slopes / self.curvature**2) + self.sectors(at_rim)

    def cut(self, centre_mm: Array, area_mm2: float) -> Array:
        """Return the covariance (6, 6), SI, by a cut of the border: a rounded end as wide is missing there.

        What of the face and its rim lies near the cut is wrong by its radius, and tilts with it.
        """
        radius = float(np.sqrt(area_mm2 / np.pi))
        face, rim = (
            np.linalg.norm(points - centre_mm, axis=1) < _CUT_RADII * radius
            for points in (self.points, self.middles)
        )
        step = radius * (self.lengths[rim] @ self.rims[rim] + self.areas[face] @ self.heights[face])
        covariance = np.outer(step, step)
        tilt = radius * float(self.areas[face].sum() / self.areas.sum()) / self.extent[[2, 0]]
        covariance[[3, 5], [3, 5]] += tilt**2
        return _to_si(covariance)


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


def shown_noise(solved: Solved) -> float:
    """Estimate the spectral density of the height noise of a surface from its face, mm4.

    Notes
    -----
    From the second difference of the heights after one, two and three steps of diffusion over s, robustly
    (median absolute deviation): a band where noise is larger than the curvature of bone, and near that in
    which noise moves the rim. White noise of density S leaves it the variance S / (5 pi s^2), the integral of
    k w^2 / 2 pi with w = q (1 - q)^2, q = 1 / (1 + s^2 k^2 / 4).
    """
    region, step = solved.region, solved.region.diffusion.step
    once = step(region.points)
    twice = step(once)
    facing = -(region.normals @ solved.axes[:, 1]) > _COSINE
    height = np.sum(((once - 2.0 * twice + step(twice)) * region.normals)[facing], axis=1)
    deviation = 1.4826 * float(np.median(np.abs(height - np.median(height)))) if len(height) else 0.0
    return 5.0 * np.pi * (NORMAL_SCALE_MM * deviation) ** 2


def _displacement(start: Solved, end: Solved) -> Array:
    """Return the small motion (6,) from one solution to another, in the axes of the first, m and rad."""
    turned = end.axes * np.sign(np.sum(end.axes * start.axes, axis=0))
    rotation = vector_from_rotation(turned @ start.axes.T)
    shift = (end.origin - start.origin) * 1e-3
    return np.concatenate([start.axes.T @ shift, start.axes.T @ rotation])
