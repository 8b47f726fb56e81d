"""The pose of the vibrometer in the footplate frame, with the errors of registration and frames."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from kinematics.place.fiducials import FRAMES, Fiducials
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform
from stapeskit.records.mass_record import MassRecord
from stapeskit.registration import Registration, fit_rigid
from stapeskit.spatial import DOF_NAMES, twist_transfer


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
        The fit of the fiducials, when there are any.
    reference : str
        Frame in which the coordinates or the references of the fiducials are given.
    """

    transform: RigidTransform
    names: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    derivative: Array = field(default_factory=lambda: np.zeros((6, 0)))
    registration: Registration | None = None
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

    Without fiducials the coordinates are in ``frame`` already: ``footplate``, ``plate`` or ``scan``. All but
    the footplate frame need a mass.

    Raises
    ------
    StapeskitError
        The frame is unknown, needs a mass.json that was not given or that has no such frame, or the fiducials
        cannot be fitted.
    """
    check_frame(fiducials, frame, mass)
    transform, fit = RigidTransform.identity(frame, frame), None
    if fiducials is not None:
        frame, fit = fiducials.frame, fit_fiducials(fiducials)
        transform = fit.transform
    sources: dict[str, tuple[Array, Array]] = {}
    if fit is not None:
        sources["registration"] = (np.eye(6), fit.covariance_si)
    if frame != "footplate" and mass is not None:
        scan_from_frame = RigidTransform.identity("scan", "scan")
        if frame == "plate" and mass.scan_from_plate is not None:
            scan_from_frame = mass.scan_from_plate
            covariance = np.zeros((6, 6)) if mass.plate_covariance is None else mass.plate_covariance
            sources["plate_frame"] = (_seen_from(transform), covariance)
        transform = mass.scan_from_footplate.inverse() @ scan_from_frame @ transform
        sources["footplate_frame"] = (-_seen_from(transform), mass.footplate_covariance)
    return Placement(
        transform,
        tuple(f"{source}.{name}" for source in sources for name in DOF_NAMES),
        block_diagonal([covariance for _, covariance in sources.values()]),
        np.hstack([np.zeros((6, 0)), *(derivative for derivative, _ in sources.values())]),
        fit,
        frame,
    )


def fit_fiducials(fiducials: Fiducials) -> Registration:
    """Return the pose of the vibrometer in the frame of the references."""
    pairs = fiducials.vibrometer_mm, fiducials.reference_mm, fiducials.sd_mm
    return fit_rigid(*pairs, to=fiducials.frame, source="vibrometer", names=fiducials.names)


def check_frame(fiducials: Fiducials | None, frame: str, mass: MassRecord | None) -> None:
    """Refuse a frame that nothing ties to the footplate; that of the fiducials where there are any.

    Raises
    ------
    StapeskitError
        The frame is unknown, needs a mass.json that was not given, or one that it does not hold.
    """
    what, where = "--frame", ""
    if fiducials is not None:
        what, where, frame = "the frame of the fiducials", f"{fiducials.file}, frame", fiducials.frame
    if frame not in FRAMES:
        raise StapeskitError.of(what, "footplate, plate or scan", frame)
    if frame != "footplate" and mass is None:
        step = "Run ct2mass and add --mass mass.json, or give coordinates in the footplate frame"
        step += "" if fiducials is None else " (--fiducials none)"
        expected = "given together with --mass mass.json, which ties that frame to the footplate"
        raise StapeskitError.of(f"{what} {frame}", expected, "no mass.json", where, step)
    if frame == "plate" and mass is not None and mass.scan_from_plate is None:
        step = "Scan stapes and plate together, or use fiducials in frame scan"
        got = "a mass.json without a plate"
        raise StapeskitError.of(f"{what} plate", "a frame of mass.json", got, where, step)


def _seen_from(frame_from_source: RigidTransform) -> Array:
    """Return a small displacement of ``frame`` in its own axes as one of the source, (6, 6)."""
    return twist_transfer(frame_from_source.rotation.T, 1e-3 * frame_from_source.translation_mm)


def block_diagonal(blocks: list[Array]) -> Array:
    """Return square matrices along one diagonal; without any, an empty one."""
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*blocks)) if blocks else np.zeros((0, 0))
