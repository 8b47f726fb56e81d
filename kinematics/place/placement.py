"""The pose of the vibrometer in the footplate frame, with the errors of registration and frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from kinematics.place.fiducials import FRAMES, Fiducials
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform
from stapeskit.paired_points import pose_rows
from stapeskit.records.mass_record import MassRecord
from stapeskit.registration import Registration, fit_rigid
from stapeskit.spatial import DOF_NAMES, twist_transfer
from stapeskit.warnings import Notice


@dataclass(frozen=True)
class Placement:
    """The pose of the measurement's frame in the footplate frame, with its shared errors.

    Attributes
    ----------
    transform : RigidTransform
        footplate_from_vibrometer (or from ``--frame``), mm.
    names : tuple of str, (p,)
        ``registration.x`` ... , ``plate_frame.x`` ... , ``footplate_frame.x`` ... : displacements of the
        vibrometer, plate and footplate frame in their own axes, m and rad; only those the pose depends on.
    covariance : ndarray, (p, p)
        SI.
    derivative : ndarray, (6, p)
        Displacement of the measurement's frame in its own axes (RigidTransform.perturbed) per parameter.
    registration : Registration or None
        The fit of the fiducials or of points on the plate, when there are any.
    reference : str
        Frame in which the coordinates or the references of the fiducials are given.
    """

    transform: RigidTransform
    names: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    derivative: Array = field(default_factory=lambda: np.zeros((6, 0)))
    registration: Registration | None = None
    notices: tuple[Notice, ...] = ()
    reference: str = "footplate"

    def changes(self, positions_m: Array, directions: Array) -> tuple[Array, Array]:
        """Return d positions and d directions, (p, c, 3) each, by the parameters, in footplate axes.

        Notes
        -----
        A displacement (u, theta) of the measurement's frame (pose R, t) moves points by R u + phi x (p - t)
        and turns beams by phi = R theta.
        """
        rotation, origin_m = self.transform.rotation, 1e-3 * self.transform.translation_mm
        shift, turn = (self.derivative[:3].T @ rotation.T, self.derivative[3:].T @ rotation.T)
        moved = shift[:, None] + np.cross(turn[:, None], positions_m - origin_m)
        return moved, np.cross(turn[:, None], directions)


def place(
    fiducials: Fiducials | None = None, frame: str = "footplate", mass: MassRecord | None = None
) -> Placement:
    """Find the pose of the measurement's coordinates in the footplate frame.

    Parameters
    ----------
    fiducials : Fiducials, optional
        Without them the coordinates are in ``frame`` already.
    frame : str
        ``footplate``, ``plate`` or ``scan``.
    mass : MassRecord, optional
        Needed for everything but the footplate frame.

    Raises
    ------
    StapeskitError
        A frame is unknown, needs a mass.json that was not given or that has no such frame, or the fiducials
        cannot be fitted.
    """
    used = (frame,) if fiducials is None else tuple(dict.fromkeys(fiducials.frames))
    check_frames(used, mass, "" if fiducials is None else fiducials.file, fiducials is not None)
    poses = _frames_in_scan(mass)
    target = used[0] if len(used) == 1 else "scan"
    fit = None if fiducials is None else _fit(fiducials, target, poses)
    to_target = RigidTransform.identity(target, target) if fit is None else fit.transform
    to_footplate = (
        RigidTransform.identity("footplate", "footplate")
        if target == "footplate"
        else poses["footplate"].inverse() @ poses[target]
    )
    transform = to_footplate @ to_target
    sources: dict[str, tuple[Array, Array]] = {}
    if fit is not None:
        sources["registration"] = (np.eye(6), fit.covariance_si)
    if set(used) != {"footplate"} and mass is not None:
        moved = _by_references(fiducials, fit, poses)
        if "plate" in used:
            own = moved.get("plate", np.zeros((6, 6)))
            own = own + (_seen_from(to_target) if target == "plate" else 0.0)
            covariance = np.zeros((6, 6)) if mass.plate_covariance is None else mass.plate_covariance
            sources["plate_frame"] = (own, covariance)
        own = moved.get("footplate", np.zeros((6, 6))) - _seen_from(transform)
        sources["footplate_frame"] = (own, mass.footplate_covariance)
    return Placement(
        transform,
        tuple(f"{source}.{name}" for source in sources for name in DOF_NAMES),
        block_diagonal([covariance for _, covariance in sources.values()]),
        np.hstack([np.zeros((6, 0)), *(derivative for derivative, _ in sources.values())]),
        fit,
        () if fit is None else fit.notices,
        target,
    )


def place_by(fit: Registration, mass: MassRecord, notices: tuple[Notice, ...] = ()) -> Placement:
    """Return the placement of a registration to the scan itself, ``scan_from_vibrometer``."""
    transform = mass.scan_from_footplate.inverse() @ fit.transform
    names = tuple(f"{source}.{name}" for source in ("registration", "footplate_frame") for name in DOF_NAMES)
    derivative = np.hstack([np.eye(6), -_seen_from(transform)])
    covariance = block_diagonal([fit.covariance_si, mass.footplate_covariance])
    return Placement(transform, names, covariance, derivative, fit, (*notices, *fit.notices), "scan")


def check_frames(
    frames: tuple[str, ...], mass: MassRecord | None, file: str = "", fiducials: bool = False
) -> None:
    """Refuse frames that nothing ties to the footplate.

    Raises
    ------
    StapeskitError
        A frame is unknown, needs a mass.json that was not given, or one that it does not hold.
    """
    what = "the frame of the fiducials" if fiducials else "--frame"
    for frame in frames:
        if frame not in FRAMES:
            raise StapeskitError.of(what, "footplate, plate or scan", frame)
        if frame != "footplate" and mass is None:
            step = "Run ct2mass and add --mass mass.json, or give coordinates in the footplate frame"
            step += " (--fiducials none)" if fiducials else ""
            expected = "given together with --mass mass.json, which ties that frame to the footplate"
            where = f"{file}, frame" if file else ""
            raise StapeskitError.of(f"{what} {frame}", expected, "no mass.json", where, step)
        if frame == "plate" and mass is not None and mass.scan_from_plate is None:
            step = "Scan stapes and plate together, or use fiducials in frame scan"
            raise StapeskitError.of(
                f"{what} plate", "a frame of mass.json", "a mass.json without a plate", file, step
            )


def _frames_in_scan(mass: MassRecord | None) -> dict[str, RigidTransform]:
    if mass is None:
        return {}
    poses = {"scan": RigidTransform.identity("scan", "scan"), "footplate": mass.scan_from_footplate}
    return poses if mass.scan_from_plate is None else poses | {"plate": mass.scan_from_plate}


def _fit(fiducials: Fiducials, target: str, poses: Mapping[str, RigidTransform]) -> Registration:
    """Fit the fiducials in their own frame when it is one for all, else in scan coordinates."""
    reference = np.array(fiducials.reference_mm, dtype=float)
    if len(set(fiducials.frames)) > 1:
        for row, frame in enumerate(fiducials.frames):
            reference[row] = poses[frame].points(reference[row])
    return fit_rigid(
        fiducials.vibrometer_mm,
        reference,
        fiducials.sd_mm,
        to=target,
        source="vibrometer",
        names=fiducials.names,
    )


def _by_references(
    fiducials: Fiducials | None, fit: Registration | None, poses: Mapping[str, RigidTransform]
) -> dict[str, Array]:
    """Return d(fitted pose)/d(frame error), (6, 6), where fiducials refer to several frames."""
    if fiducials is None or fit is None or len(set(fiducials.frames)) == 1:
        return {}
    rows = fit.transform.rotation @ pose_rows(1e-3 * fiducials.vibrometer_mm)
    weight = np.repeat(1.0 / fit.sd_mm, 3)[:, None]
    found: dict[str, Array] = {}
    for frame in ("plate", "footplate"):
        own = np.array([name == frame for name in fiducials.frames])
        moved = np.zeros(rows.shape)
        if own.any():
            moved[own] = poses[frame].rotation @ pose_rows(1e-3 * fiducials.reference_mm[own])
        design, target = (part.reshape(-1, 6) * weight for part in (rows, moved))
        found[frame] = np.asarray(np.linalg.lstsq(design, target, rcond=None)[0], dtype=float)
    return found


def _seen_from(frame_from_source: RigidTransform) -> Array:
    """Return a small displacement of ``frame`` in its own axes as one of the source, (6, 6)."""
    return twist_transfer(frame_from_source.rotation.T, 1e-3 * frame_from_source.translation_mm)


def block_diagonal(blocks: list[Array]) -> Array:
    """Return square matrices along one diagonal."""
    size = sum(len(block) for block in blocks)
    whole = np.zeros((size, size))
    start = 0
    for block in blocks:
        whole[start : start + len(block), start : start + len(block)] = block
        start += len(block)
    return whole
