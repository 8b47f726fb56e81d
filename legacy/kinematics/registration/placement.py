"""Where the vibrometer's coordinates are in the footplate frame, and how errors of the frames move that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.registration.fiducials import Fiducials
from legacy.stapeskit.alignment.registration import Registration, displacement, fit_rigid
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.option_names import named
from legacy.stapeskit.records.mass_record import MassRecord
from legacy.stapeskit.spatial import DOF_NAMES
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from legacy.kinematics.registration.surface_check import SurfaceCheck

# Step of central differences, rad and mm: the third root of rounding.
_STEP = 1e-5


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
        The fit of the fiducials or of points on a surface, when there are any.
    checks : tuple of SurfaceCheck
        Measured points against the surfaces of the scan (kinematics.registration.sample_displacement).
    """

    transform: RigidTransform
    names: tuple[str, ...] = ()
    covariance: Array = None  # type: ignore[assignment]
    derivative: Array = None  # type: ignore[assignment]
    registration: Registration | None = None
    notices: tuple[Notice, ...] = ()
    checks: tuple[SurfaceCheck, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.names)
        if self.covariance is None:
            object.__setattr__(self, "covariance", np.zeros((count, count)))
        if self.derivative is None:
            object.__setattr__(self, "derivative", np.zeros((6, count)))


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
    KinematicsError
        A frame is unknown, needs a mass.json that was not given or that has no such frame, or the fiducials
        cannot be fitted.
    """
    frames = (frame,) if fiducials is None else tuple(dict.fromkeys(fiducials.frames))
    _check_frames(frames, mass, fiducials)
    fitted = None if fiducials is None else _fit(fiducials, mass, np.zeros(6), np.zeros(6))

    def pose(plate: Array, footplate: Array) -> RigidTransform:
        if fiducials is None or fitted is None:
            return _to_footplate(frame, mass, plate, footplate)
        # only references in several frames move against each other with the errors of the frames
        fit = fitted if len(frames) == 1 else _fit(fiducials, mass, plate, footplate)
        return _to_footplate(fit.transform.to, mass, plate, footplate) @ fit.transform

    transform = pose(np.zeros(6), np.zeros(6))
    names: list[str] = []
    columns: list[Array] = []
    blocks: list[Array] = []
    if fitted is not None:
        names += [f"registration.{name}" for name in DOF_NAMES]
        columns.append(np.eye(6))
        blocks.append(fitted.covariance_si)
    if "plate" in frames and mass is not None:
        names += [f"plate_frame.{name}" for name in DOF_NAMES]
        columns.append(_derivative(lambda e: pose(e, np.zeros(6)), transform))
        blocks.append(np.zeros((6, 6)) if mass.plate_covariance is None else mass.plate_covariance)
    if set(frames) != {"footplate"} and mass is not None:
        names += [f"footplate_frame.{name}" for name in DOF_NAMES]
        columns.append(_derivative(lambda e: pose(np.zeros(6), e), transform))
        blocks.append(mass.footplate_covariance)
    return Placement(
        transform,
        tuple(names),
        _block_diagonal(blocks),
        np.hstack(columns) if columns else np.zeros((6, 0)),
        fitted,
        () if fitted is None else fitted.notices,
    )


def _check_frames(frames: tuple[str, ...], mass: MassRecord | None, fiducials: Fiducials | None) -> None:
    what = "the frame of the fiducials" if fiducials is not None else named("frame")
    file = fiducials.path.name if fiducials is not None and fiducials.path is not None else ""
    for frame in frames:
        if frame not in ("footplate", "plate", "scan"):
            raise KinematicsError.of(what, "footplate, plate or scan", frame)
        if frame == "footplate":
            continue
        if mass is None:
            raise KinematicsError.of(
                f"{what} {frame}",
                "given together with {mass} mass.json, which ties that frame to the footplate",
                "no mass record",
                f"{file}, frame" if file else "",
                next_step="Add {mass}, or give the coordinates in the footplate frame",
            )
        if frame == "plate" and mass.plate_from_footplate is None:
            raise KinematicsError.of(
                f"{what} plate",
                "a frame of mass.json",
                "a mass.json without a plate",
                next_step="Scan stapes and plate together, or use fiducials in frame scan",
            )


def _fit(fiducials: Fiducials, mass: MassRecord | None, plate: Array, footplate: Array) -> Registration:
    """Fit the fiducials, in their own frame when it is one for all, else in scan coordinates."""
    frames = set(fiducials.frames)
    target = frames.pop() if len(frames) == 1 else "scan"
    reference = np.array(fiducials.reference_mm, dtype=float)
    if len(set(fiducials.frames)) > 1 and mass is not None:
        for name in ("plate", "footplate"):
            rows = np.array([frame == name for frame in fiducials.frames])
            if rows.any():
                reference[rows] = _to_scan(name, mass, plate, footplate).points(reference[rows])
    return fit_rigid(
        fiducials.vibrometer_mm,
        reference,
        fiducials.sd_mm,
        to=target,
        source="vibrometer",
        names=fiducials.names,
        target_sd_mm=fiducials.sd_ref_mm,
    )


def _to_scan(frame: str, mass: MassRecord, plate: Array, footplate: Array) -> RigidTransform:
    if frame == "footplate":
        return mass.scan_from_footplate.perturbed(footplate)
    if frame == "plate" and mass.plate_from_footplate is not None:
        return (mass.scan_from_footplate @ mass.plate_from_footplate.inverse()).perturbed(plate)
    return RigidTransform.identity("scan", "scan")


def _to_footplate(frame: str, mass: MassRecord | None, plate: Array, footplate: Array) -> RigidTransform:
    if frame == "footplate" or mass is None:
        return RigidTransform.identity("footplate", frame)
    return mass.scan_from_footplate.perturbed(footplate).inverse() @ _to_scan(frame, mass, plate, footplate)


def _derivative(pose: Callable[[Array], RigidTransform], base: RigidTransform) -> Array:
    """Return d(displacement of the source frame)/d(frame error), (6, 6), by central differences."""
    columns = []
    for axis in range(6):
        small = np.zeros(6)
        small[axis] = _STEP
        columns.append((displacement(base, pose(small)) - displacement(base, pose(-small))) / (2.0 * _STEP))
    return np.column_stack(columns)


def place_on_surface(fit: Registration, mass: MassRecord) -> Placement:
    """Find the pose from a registration to the scan itself.

    Parameters
    ----------
    fit : Registration
        scan_from_vibrometer.

    Raises
    ------
    KinematicsError
        The registration leads to another frame than the scan's.
    """

    def pose(footplate: Array) -> RigidTransform:
        return mass.scan_from_footplate.perturbed(footplate).inverse() @ fit.transform

    transform = pose(np.zeros(6))
    names = tuple(f"{source}.{name}" for source in ("registration", "footplate_frame") for name in DOF_NAMES)
    derivative = np.hstack([np.eye(6), _derivative(pose, transform)])
    covariance = _block_diagonal([fit.covariance_si, mass.footplate_covariance])
    return Placement(transform, names, covariance, derivative, fit, fit.notices)


def scan_guess(placement: Placement, mass: MassRecord) -> tuple[RigidTransform, Array]:
    """Return scan_from_vibrometer and its covariance, to which the footplate frame does not contribute."""
    keep = [k for k, name in enumerate(placement.names) if not name.startswith("footplate_frame")]
    slopes = placement.derivative[:, keep]
    covariance = slopes @ placement.covariance[np.ix_(keep, keep)] @ slopes.T
    return mass.scan_from_footplate @ placement.transform, covariance


def _block_diagonal(blocks: list[Array]) -> Array:
    size = sum(len(block) for block in blocks)
    whole = np.zeros((size, size))
    start = 0
    for block in blocks:
        whole[start : start + len(block), start : start + len(block)] = block
        start += len(block)
    return whole
