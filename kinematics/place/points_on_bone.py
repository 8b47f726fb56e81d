"""Do measured points lie on the bone of the scan? Other axes and units are tried before the sample is
blamed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kinematics.calibrated import calibrated
from kinematics.measurement import BodyChannels, Measurement
from kinematics.place.handedness import UNITS, axes_changes
from kinematics.place.placement import Placement
from kinematics.place.surfaces import Surface
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.frames import RigidTransform
from stapeskit.records.mass_record import MassRecord
from stapeskit.spatial import point_rows
from stapeskit.warnings import Notice

MOST_DISTANCE_MM = 1.0
"""Root mean square distance of the points of a body from its surface from which on a registration is
refused: a third of a stapes."""

_UNLIKELY = 1e-3
_USUAL_SD_MM = 0.1  # of a position that states none: marks are set so well
_CURED = 0.3  # share of the distance that other axes or units may leave
_LEAST_POINTS = 3
_REACH_MM = 8.0  # a stapes is about 3.5 mm high and 3 mm long
_LEAST_EXTENT_MM = 0.2  # of points that may show their axes or unit: a smaller cloud lies on any surface
_EXTENT_MM = (0.03, 300.0)  # of the points of a body, from a laser spot on: metres make 20 mm look like 20 um


@dataclass(frozen=True)
class SurfaceCheck:
    """Measured points of one body against the surface that they must lie on.

    Attributes
    ----------
    body : str
        Also the name of the surface.
    points : tuple of str, (n,)
    distance_mm : ndarray, (n,)
        Signed distance from the surface, outside positive.
    expected_sd_mm : ndarray, (n,)
        What position, surface and registration let expect.
    p_value : float
        Of the sum of squares of all distances with their joint covariance.
    """

    body: str
    points: tuple[str, ...]
    distance_mm: Array
    expected_sd_mm: Array
    p_value: float

    @property
    def rms_mm(self) -> float:
        """Root mean square distance from the surface."""
        return float(np.sqrt(np.mean(self.distance_mm**2)))

    @property
    def words(self) -> str:
        """Rms and worst distance in words."""
        worst = int(np.argmax(np.abs(self.distance_mm)))
        return (
            f"{1e3 * self.rms_mm:.0f} um rms off the surface of the {self.body} in the scan (point "
            f"{self.points[worst]}: {1e3 * self.distance_mm[worst]:+.0f} um)"
        )


def check_surfaces(
    measurement: Measurement, placement: Placement, mass: MassRecord, surfaces: Mapping[str, Surface]
) -> tuple[tuple[SurfaceCheck, ...], list[Notice]]:
    """Compare points of stapes and plate, measured in the source frame, with their surfaces in the scan.

    Raises
    ------
    StapeskitError
        The points lie more than a millimetre off, or other axes or units bring them onto the surface.
    """
    to_scan = mass.scan_from_footplate @ placement.transform
    checks, notices = [], []
    for body in measurement.bodies:
        if body.body not in surfaces or len(set(body.points)) < _LEAST_POINTS:
            continue
        surface = surfaces[body.body]
        check = _check(body, surface, placement, to_scan)
        checks.append(check)
        if check.p_value >= _UNLIKELY and check.rms_mm < MOST_DISTANCE_MM:
            continue
        _refuse_other_axes(check, body, placement, mass, surface)
        if check.rms_mm > MOST_DISTANCE_MM:
            step = "Check fiducials, their frame and points; neither other axes, units nor frames explain it"
            if placement.registration is None:
                step = (
                    "Coordinates of the vibrometer need --fiducials, others the name of their frame "
                    "(--frame); neither other axes, units nor frames explain it"
                )
            expected = f"on the bone within {MOST_DISTANCE_MM:g} mm after registration"
            raise StapeskitError.of(f"the points of body {body.body}", expected, check.words, "", step)
        text = (
            f"the {len(check.points)} points of {body.body} lie {check.words}, p {check.p_value:.1g}: the "
            "sample moved after the scan, or the registration is wrong."
        )
        notices.append(Notice("sample_moved", text))
    return tuple(checks), notices


def check_extent(measurement: Measurement) -> None:
    """Refuse points of a body within 30 um, or far apart: their coordinates are in another unit.

    Raises
    ------
    StapeskitError
        Points of some bodies are so.
    """
    faults = []
    assumed = any(notice.code == "length_unit_assumed" for notice in measurement.notices)
    for body in measurement.bodies:
        extent = 1e3 * float(np.max(np.ptp(body.arms_m, axis=0)))
        if extent > 0.0 and not _EXTENT_MM[0] <= extent <= _EXTENT_MM[1]:
            unit = "metres times" if extent < _EXTENT_MM[0] else "micrometres over"
            step = f"Give coordinates in mm: those in {unit} 1000"
            step = "State their unit with --length-unit" if assumed else step
            thing = f"the extent of the points of body {body.body}"
            faults.append(Fault(thing, "some mm", f"{extent:.3g} mm", "", step))
    raise_all(faults)


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
    from scipy.special import chdtrc

    names = tuple(dict.fromkeys(body.points))
    first = [body.points.index(name) for name in names]
    own_mm = 1e3 * body.arms_m[first]
    distance, normal = surface.signed(to_scan.points(own_mm))
    stated = 1e3 * body.position_sd_m[first]
    own_sd = np.where(stated > 0.0, stated, _USUAL_SD_MM)
    spread = np.hypot(own_sd, calibrated("sample_moved.surface_sd_edges") * surface.edge_mm)
    # the frame of the footplate is fitted in the scan: its error moves points and surface alike
    kept = [k for k, name in enumerate(placement.names) if not name.startswith("footplate_frame")]
    rows = point_rows(1e-3 * own_mm, to_scan.inverse().vectors(normal)) @ placement.derivative[:, kept] * 1e3
    joint = np.diag(spread**2) + rows @ placement.covariance[np.ix_(kept, kept)] @ rows.T
    chi2 = float(distance @ np.linalg.solve(joint, distance))
    return SurfaceCheck(
        body.body, names, distance, np.sqrt(np.diag(joint)), float(chdtrc(len(distance), chi2))
    )


def _refuse_other_axes(
    check: SurfaceCheck, body: BodyChannels, placement: Placement, mass: MassRecord, surface: Surface
) -> None:
    """Refuse points that other axes, another unit or another frame bring onto the surface.

    Axes of points are those of the file, before --mirror.

    Raises
    ------
    StapeskitError
        Names the change that does.
    """
    points_mm = 1e3 * body.arms_m[[body.points.index(name) for name in check.points]]
    to_scan = mass.scan_from_footplate @ placement.transform
    reference = placement.reference
    frames = {"scan": RigidTransform.identity("scan", "scan"), "footplate": mass.scan_from_footplate}
    frames |= {} if mass.scan_from_plate is None else {"plate": mass.scan_from_plate}
    from_reference = frames[reference]
    inside = from_reference.inverse().points(to_scan.points(points_mm))
    to_file = body.file_from_here
    tried = {
        f"the frame of the coordinates with {name} instead of {reference}": other.points(inside)
        for name, other in frames.items()
        if name != reference
    }
    for words, change in {**axes_changes(), **UNITS}.items():
        moved_mm = points_mm @ (to_file.T @ change @ to_file).T
        tried[f"the coordinates of the points with {words}"] = to_scan.points(moved_mm)
        if abs(np.linalg.det(change) - 1.0) < 1e-9 or placement.registration is None:
            tried[f"the coordinates in frame {reference} with {words}"] = from_reference.points(
                inside @ change.T
            )
    sizes = {
        words: float(np.sqrt(np.mean(surface.signed(at)[0] ** 2)))
        for words, at in tried.items()
        if float(np.max(np.ptp(at, axis=0))) > _LEAST_EXTENT_MM
    }
    best = min(sizes, key=lambda words: sizes[words], default="")
    if best and sizes[best] < _CURED * check.rms_mm:
        changed = best.partition(" with ")[2]
        got = f"{check.rms_mm:.2g} mm off it as given, {sizes[best]:.2g} mm with {changed}"
        expected = "on the bone of the scan after registration"
        raise StapeskitError.of(f"the points of body {body.body}", expected, got, "", f"Give {best}")
