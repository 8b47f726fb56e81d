"""Did the sample keep its place between scan and measurement? Measured points against the scan's surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kinematics.calibrated import calibrated
from kinematics.measurement import BodyChannels, Measurement
from kinematics.place.handedness import axes_changes, units_changes
from kinematics.place.placement import Placement
from kinematics.place.surfaces import Surface
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform
from stapeskit.records.mass_record import MassRecord
from stapeskit.spatial import point_rows
from stapeskit.warnings import Notice

FARTHEST_MM = 1.0
"""Root mean square distance of the points of a stapes from its surface from which on a registration is
refused: a third of a stapes."""
LEAST_APART_MM = 1e-2
"""Extent of the points of a stapes below which they are in another unit: in metres, its 3 mm look like 3
um."""

_SURFACE_SD_EDGES = calibrated("sample_moved.surface_sd_edges")
_UNLIKELY = 1e-3
_NOTICEABLE_MM = 0.1  # distances from which on other axes are looked for: marks are set so well
_CURED = 0.3  # share of the distance that such a cause may leave
_LEAST_POINTS = 3
_REACH_MM = 8.0  # a stapes is about 3.5 mm high and 3 mm long
_MOST_APART_MM = 100.0  # points of one stapes: thirty times its height


@dataclass(frozen=True)
class SurfaceCheck:
    """Measured points of one body against the surface that they must lie on.

    Attributes
    ----------
    body, surface : str
    points : tuple of str, (n,)
    distance_mm : ndarray, (n,)
        Signed distance from the surface, outside positive.
    expected_sd_mm : ndarray, (n,)
        What position, surface and registration let expect.
    chi2, n_dof, p_value : float, int, float
        Of all distances with their joint covariance; where no sd of positions is stated, of the rigid shift
        that explains them best against the scatter around it.
    """

    body: str
    surface: str
    points: tuple[str, ...]
    distance_mm: Array
    expected_sd_mm: Array
    chi2: float
    n_dof: int
    p_value: float

    @property
    def rms_mm(self) -> float:
        """Root mean square distance from the surface."""
        return float(np.sqrt(np.mean(self.distance_mm**2)))


def check_surfaces(
    measurement: Measurement, placement: Placement, mass: MassRecord, surfaces: Mapping[str, Surface]
) -> tuple[tuple[SurfaceCheck, ...], list[Notice]]:
    """Compare measured points of stapes and plate with their surfaces in the scan.

    Parameters
    ----------
    measurement : Measurement
        In its own frame, the source of ``placement``.

    Raises
    ------
    StapeskitError
        The points lie more than a millimetre off, or other axes or units bring them onto the surface.
    """
    to_scan = mass.scan_from_footplate @ placement.transform
    checks = tuple(
        _check(body, surfaces[body.body], placement, to_scan)
        for body in measurement.bodies
        if body.body in surfaces and len(set(body.points)) >= _LEAST_POINTS
    )
    notices = []
    for check in checks:
        if check.p_value >= _UNLIKELY and check.rms_mm < FARTHEST_MM:
            continue
        body = next(one for one in measurement.bodies if one.body == check.body)
        if check.rms_mm > _NOTICEABLE_MM:
            _refuse_other_axes(check, body, placement, mass, surfaces[check.body])
        size = f"{1e3 * check.rms_mm:.0f} um rms off the surface of the {check.surface} in the scan"
        if check.rms_mm > FARTHEST_MM:
            step = "Check fiducials, their frame and points; neither other axes nor other units explain it"
            expected = f"on the bone within {FARTHEST_MM:g} mm after registration"
            raise StapeskitError.of(f"the points of body {check.body}", expected, size, "", step)
        text = (
            f"the {len(check.points)} points of {check.body} lie {size} (p {check.p_value:.1g}): the sample "
            "moved after the scan, or the registration is wrong."
        )
        notices.append(Notice("sample_moved", text))
    return checks, notices


def check_extent(measurement: Measurement) -> None:
    """Refuse points of a stapes within 10 um, or far apart: their coordinates are in another unit.

    Raises
    ------
    StapeskitError
        They do.
    """
    for body in measurement.bodies:
        if body.body == "stapes" and len(set(body.points)) > 1:
            extent = 1e3 * float(np.max(np.ptp(body.arms_m, axis=0)))
            if 0.0 < extent < LEAST_APART_MM:  # all at one place is another fault: beams.py names it
                got, step = f"{1e3 * extent:.3g} um", "Give coordinates in mm: those in metres times 1000"
            elif extent > _MOST_APART_MM:
                got, step = f"{extent:.3g} mm", "Give coordinates in mm: those in micrometres over 1000"
            else:
                continue
            raise StapeskitError.of("the extent of the points of body stapes", "some mm", got, "", step)


def far_away(placed: Measurement) -> list[Notice]:
    """Warn when the points of the stapes lie where no stapes reaches, as in a foreign frame."""
    for body in placed.bodies:
        distance = 1e3 * float(np.linalg.norm(np.mean(body.arms_m, axis=0)))
        if body.body == "stapes" and distance > _REACH_MM:
            text = (
                f"the points of body stapes lie {distance:.3g} mm from the footplate centre in the mean, "
                "farther than a stapes reaches: their coordinates look like those of another frame. Tie it "
                "to the footplate with --fiducials, or name it with --frame; the motion is about a point "
                "far from the bone."
            )
            return [Notice("far_from_footplate", text)]
    return []


def _check(
    body: BodyChannels, surface: Surface, placement: Placement, to_scan: RigidTransform
) -> SurfaceCheck:
    first = [body.points.index(name) for name in dict.fromkeys(body.points)]
    names = tuple(body.points[place] for place in first)
    own_mm = 1e3 * body.arms_m[first]
    placed = to_scan.points(own_mm)
    distance, normal = surface.signed(placed)
    stated = body.position_sd_m[first] * 1e3
    known = bool(np.all(stated > 0.0))
    spread = np.hypot(np.where(known, stated, 0.0), _SURFACE_SD_EDGES * surface.edge_mm)
    # the frame of the footplate is fitted in the scan: its error moves points and surface alike
    kept = [k for k, name in enumerate(placement.names) if not name.startswith("footplate_frame")]
    rows = point_rows(1e-3 * own_mm, to_scan.inverse().vectors(normal)) @ placement.derivative[:, kept] * 1e3
    joint = np.diag(spread**2) + rows @ placement.covariance[np.ix_(kept, kept)] @ rows.T
    expected = np.sqrt(np.diag(joint))
    chi2, freedom, p = _whole_test(distance, joint) if known else _shift_test(distance, placed, normal)
    return SurfaceCheck(body.body, surface.name, names, distance, expected, chi2, freedom, p)


def _whole_test(distance: Array, joint: Array) -> tuple[float, int, float]:
    from scipy.special import chdtrc

    chi2 = float(distance @ np.linalg.solve(joint, distance))
    return chi2, len(distance), float(chdtrc(len(distance), chi2))


def _shift_test(distance: Array, placed: Array, normal: Array) -> tuple[float, int, float]:
    """Return the F test of a rigid shift against the scatter around it, as a sum of squares."""
    from scipy.special import fdtrc

    middle = placed.mean(axis=0)
    design = point_rows(placed - middle, normal)
    solution, _, rank, _ = np.linalg.lstsq(design, distance, rcond=1e-3)
    free = len(distance) - int(rank)
    if free < 1:
        return float("nan"), 0, 1.0
    rest = float(np.sum((distance - design @ solution) ** 2))
    gain = float(np.sum(distance**2)) - rest
    ratio = gain / int(rank) / max(rest / free, 1e-8)
    return ratio * int(rank), int(rank), float(fdtrc(int(rank), free, ratio))


def _refuse_other_axes(
    check: SurfaceCheck, body: BodyChannels, placement: Placement, mass: MassRecord, surface: Surface
) -> None:
    """Refuse points that other axes or another unit bring onto the surface.

    Raises
    ------
    StapeskitError
        Names the change that does.
    """
    points_mm = 1e3 * body.arms_m[[body.points.index(name) for name in check.points]]
    to_scan = mass.scan_from_footplate @ placement.transform
    scan_from_reference = {
        "footplate": mass.scan_from_footplate,
        "scan": RigidTransform.identity("scan", "scan"),
        "plate": mass.scan_from_plate or mass.scan_from_footplate,
    }[placement.reference]
    tried: dict[str, Array] = {}
    for words, change in {**axes_changes(), **units_changes()}.items():
        tried[f"the coordinates of the points with {words}"] = to_scan.points(points_mm @ change.T)
        if abs(np.linalg.det(change) - 1.0) < 1e-9 or placement.registration is None:
            inside = scan_from_reference.inverse().points(to_scan.points(points_mm))
            turned = scan_from_reference.points(inside @ change.T)
            tried[f"the coordinates in frame {placement.reference} with {words}"] = turned
    sizes = {
        words: float(np.sqrt(np.mean(surface.signed(placed)[0] ** 2))) for words, placed in tried.items()
    }
    best = min(sizes, key=lambda words: sizes[words])
    if sizes[best] < _CURED * check.rms_mm:
        got = (
            f"{check.rms_mm:.2g} mm off it as given, {sizes[best]:.2g} mm with {best.partition(' with ')[2]}"
        )
        raise StapeskitError.of(
            f"the points of body {check.body}",
            "on the bone of the scan after registration",
            got,
            "",
            f"Give {best}",
        )
