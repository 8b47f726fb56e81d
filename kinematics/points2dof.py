"""From what the beams read to the motion of rigid bodies about the footplate centre: one library call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.errors import KinematicsError
from kinematics.faults.across.all_bodies import told_across
from kinematics.faults.across.lines import column_offset, exchanged_lines
from kinematics.faults.across.phase import phase_notice
from kinematics.faults.causes.explain import explained
from kinematics.faults.diagnose import Diagnosis
from kinematics.faults.records import searched_body
from kinematics.faults.screening import Screened, empty_faults, is_whole, screened
from kinematics.faults.unit_slips import unit_slips
from kinematics.faults.verdicts import ChannelVerdict, channel_verdicts, fault_notices
from kinematics.fit.beams import BeamSet, beam_set, unseen_motions
from kinematics.fit.body_noise import with_noise
from kinematics.fit.frf_ratio import parse_reference, per_reference
from kinematics.fit.neglected_motion import neglected_notice
from kinematics.fit.reference_noise import with_record_noise
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels, Measurement
from kinematics.options import LdvOptions
from kinematics.registration.calibrate import Calibration
from kinematics.registration.calibrated_fit import calibrated, calibration_errors
from kinematics.registration.geometry_model import GeometryPriors
from kinematics.registration.handedness import check_axes
from kinematics.registration.placement import Placement, place
from kinematics.registration.shared_errors import pose_derivatives, position_errors
from kinematics.repeats.comparison import RunRepeats
from kinematics.repeats.pooling import pooled, separate, with_gain_errors
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.records.mass_record import MassRecord
from stapeskit.records.motion import RigidMotion, SharedErrors
from stapeskit.spatial import DOF_NAMES
from stapeskit.vocabulary import named
from stapeskit.warnings import Notice, unique

Array = NDArray[np.float64]
ROBUST = ("none", "huber", "t4")
REPEATS = ("pool", "separate")
_FARTHEST_MM = 8.0


@dataclass(frozen=True)
class Options:
    """Choices of a fit.

    Attributes
    ----------
    dof : tuple of str
        In the order of DOF_NAMES.
    reference : str
        ``BODY:DOF`` for responses per unit of that motion; empty for absolute motion.
    robust : str
        ``none``, ``huber`` or ``t4``.
    calibrate : GeometryPriors or None
        Estimate the geometry together with the motion.
    repeats : str
        ``pool`` repeats and levels of each run after comparing them, or keep them ``separate`` as runs of
        their own.
    reference_noise : float
        Standard deviation of the real (= imaginary) part of the relative noise of the signal that all
        readings refer to; it enters the covariance of absolute motion.

    Raises
    ------
    KinematicsError
        An unknown degree of freedom, robust estimator or way with repeats, or a noise of the reference that
        is no share.
    """

    dof: tuple[str, ...] = DOF_NAMES
    reference: str = ""
    robust: str = "none"
    calibrate: GeometryPriors | None = None
    repeats: str = "pool"
    reference_noise: float = 0.0

    def __post_init__(self) -> None:
        faults = []
        if self.robust not in ROBUST:
            faults.append(Fault("{robust}", f"one of {', '.join(ROBUST)}", self.robust))
        if self.repeats not in REPEATS:
            faults.append(Fault("{repeats}", f"one of {', '.join(REPEATS)}", self.repeats))
        if not 0.0 <= self.reference_noise < 1.0:
            faults.append(Fault("{reference_noise}", "from 0 to below 1", f"{self.reference_noise:g}"))
        if not self.dof or tuple(name for name in DOF_NAMES if name in self.dof) != self.dof:
            faults.append(Fault("dof", f"names in the order {', '.join(DOF_NAMES)}", self.dof))
        raise_all(KinematicsError, faults)


def fit_options(options: LdvOptions) -> Options:
    """Return the choices of the fit out of the options of the command or of a study."""
    usual = GeometryPriors()
    priors = GeometryPriors(
        usual.axes_sd_deg if options.axes_sd_deg is None else options.axes_sd_deg,
        usual.beam_sd_deg if options.beam_sd_deg is None else options.beam_sd_deg,
        usual.gain_sd_percent if options.gain_sd_percent is None else options.gain_sd_percent,
    )
    return Options(
        options.dof,
        options.reference,
        options.robust,
        priors if options.calibrate else None,
        options.repeats,
        options.reference_noise,
    )


@dataclass(frozen=True)
class Points2Dof:
    """The result.

    Attributes
    ----------
    motion : RigidMotion
        With covariance, shared errors and all notices.
    channels : tuple of ChannelVerdict
    measurement : Measurement
        In the footplate frame.
    placement : Placement
    fits : mapping of (run, body) to LineFit
        By position.
    diagnoses : mapping of (run, body) to Diagnosis
    options : Options
    unseen : mapping of str to tuple of str
        By body: the rigid motions that its beams cannot see, in words.
    calibration : Calibration or None
        The geometry as estimated, when that was asked for.
    repeats : tuple of RunRepeats
        What the comparison of repeats and levels gave, for each run that had any.
    """

    motion: RigidMotion
    channels: tuple[ChannelVerdict, ...]
    measurement: Measurement
    placement: Placement
    fits: Mapping[tuple[int, int], LineFit]
    diagnoses: Mapping[tuple[int, int], Diagnosis]
    options: Options
    unseen: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    calibration: Calibration | None = None
    repeats: tuple[RunRepeats, ...] = ()

    @property
    def notices(self) -> tuple[Notice, ...]:
        """Every warning."""
        return self.motion.notices


def points2dof(
    measurement: Measurement,
    placement: Placement | None = None,
    options: Options | None = None,
    mass: MassRecord | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> Points2Dof:
    """Fit the motion of every rigid body about the footplate centre, in footplate axes, at every line.

    Parameters
    ----------
    measurement : Measurement
        Positions and directions in the source frame of ``placement``.
    placement : Placement, optional
        From kinematics.registration.placement.place; without it the measurement is in the footplate frame.
    options : Options, optional
    mass : MassRecord, optional
        Only used to recognise the phase convention.
    provenance : mapping, optional
        Carried along in the result.

    Raises
    ------
    KinematicsError
        The beams of a body cannot observe the degrees of freedom, the reference is no fitted motion, a
        body has no usable value, or too few channels at every line, or positions and beams agree only when
        one of them is mirrored.
    """
    options = options or Options()
    placement = placement or place()
    if options.reference:
        parse_reference(options.reference, tuple(body.body for body in measurement.bodies), options.dof)
    whole = all(is_whole(body) for body in measurement.bodies)
    if not whole:
        raise_all(KinematicsError, empty_faults(measurement))
    slips = unit_slips(measurement)
    repeats = pooled(measurement) if options.repeats == "pool" else separate(measurement)
    measurement = repeats.measurement
    placed = measurement.mapped(placement.transform)
    beams = _beam_sets(placed, options.dof)
    screens = [
        Screened(body, tuple({} for _ in placed.runs), ())
        if whole
        else screened(body, placed.runs, options.dof)
        for body in placed.bodies
    ]
    placed = replace(placed, bodies=tuple(screen.body for screen in screens))
    calibration = None
    if options.calibrate is not None:
        calibration = calibrated(placed, options.dof, options.calibrate, options.robust)
        placed = calibration.measurement
        screens = [replace(screen, body=body) for screen, body in zip(screens, placed.bodies, strict=True)]
        beams = _beam_sets(placed, options.dof)
    fits: dict[tuple[int, int], LineFit] = {}
    searched: dict[tuple[int, int], LineFit] = {}
    diagnoses: dict[tuple[int, int], Diagnosis] = {}
    known: dict[tuple[int, int], bool] = {}
    verdicts: list[ChannelVerdict] = []
    notices = [*measurement.notices, *placement.notices, *slips]
    notices += [] if calibration is None else calibration.notices
    for screen in screens:
        notices += screen.notices
    notices += [] if whole else _uncommon_lines(placed)
    notices += _far_away(placed)
    for run in range(len(placed.runs)):
        for number, screen in enumerate(screens):
            key = (run, number)
            fits[key], known[key], said = with_noise(placed, run, screen.body, beams[number], options.robust)
            notices += said
            diagnoses[key], searched[key] = searched_body(placed, run, screen.body, fits[key], known[key])
    # Rows under a wrong label are single values far off, too: the narrower cause is looked for first.
    exchanged = told_across(placed, searched, diagnoses, known)
    for run in range(len(placed.runs)):
        for number, screen in enumerate(screens):
            key = (run, number)
            if key not in exchanged:
                other = explained(placed, run, screen.body, searched[key], known[key], diagnoses[key])
                diagnoses[key], searched[key] = other or (diagnoses[key], searched[key])
    diagnoses |= exchanged
    for run in range(len(placed.runs)):
        for number, screen in enumerate(screens):
            key = (run, number)
            notices += _body_notices(placed, run, screen.body, fits[key], diagnoses[key], known[key])
            verdicts += _verdicts(placed.runs[run], screen, run, fits[key], diagnoses[key])
    notices += check_axes(placed, placement.transform, fits, _left_by_one(diagnoses))
    motion = with_record_noise(_motion(placed, fits, options.dof), placed, fits)
    _check_determined(motion)
    motion = replace(
        motion,
        shared=_shared(placed, fits, placement, motion, calibration),
        provenance=dict(provenance or {}),
    )
    motion = with_gain_errors(motion, repeats.repeats if options.repeats == "pool" else ())
    if not _spoils_motion(diagnoses):
        notices += exchanged_lines(motion) + phase_notice(motion, mass)
    if not options.reference and (options.reference_noise > 0.0 or measurement.common_sd is not None):
        measured = 0.0 if measurement.common_sd is None else measurement.common_sd
        motion = motion.with_common_noise(np.hypot(options.reference_noise, measured))
    if options.reference:
        motion = per_reference(motion, options.reference)
        notices += motion.notices
    motion = replace(motion, notices=unique(notices))
    unseen = {body.body: tuple(unseen_motions(body.positions_mm, body.directions)) for body in placed.bodies}
    return Points2Dof(
        motion,
        tuple(verdicts),
        placed,
        placement,
        fits,
        diagnoses,
        options,
        unseen,
        calibration,
        repeats.repeats,
    )


def _uncommon_lines(placed: Measurement) -> list[Notice]:
    """Tell which bodies were not measured at all lines of the others."""
    measured = [_measured_lines(body) for body in placed.bodies]
    counts = [int(np.sum(lines)) for lines in measured]
    if all(count == len(placed.freq_hz) for count in counts):
        return []
    said = ", ".join(f"{body.body} at {n}" for body, n in zip(placed.bodies, counts, strict=True))
    common = int(np.sum(np.all(measured, axis=0)))
    text = (
        f"of {len(placed.freq_hz)} frequencies, {said} were measured, {common} of them on all bodies; "
        "lines are matched within 1e-6."
    )
    text += column_offset(placed.freq_hz, measured, [body.body for body in placed.bodies])
    return [Notice("frequencies_differ", text)]


def _measured_lines(body: BodyChannels) -> NDArray[np.bool_]:
    """Return the lines (freq,) at which any channel of any run was measured."""
    found = np.zeros(body.displacement.shape[2], dtype=bool)
    for at in np.ndindex(body.displacement.shape[:2]):
        found |= np.isfinite(body.displacement[at].real)
        if np.all(found):
            break
    return found


def _beam_sets(placed: Measurement, dof: tuple[str, ...]) -> list[BeamSet]:
    """Factorise every body; what any of them cannot observe is told in one message."""
    made: list[BeamSet] = []
    faults: list[Fault] = []
    for body in placed.bodies:
        try:
            made.append(beam_set(body.body, body.positions_mm, body.directions, dof))
        except StapeskitError as fault:
            faults += fault.faults
    raise_all(KinematicsError, faults)
    return made


def _left_by_one(diagnoses: Mapping[tuple[int, int], Diagnosis]) -> dict[tuple[int, int], float]:
    """Return the share of each misfit that a single fault, other than of all beams, does not explain."""
    return {key: found.kept for key, found in diagnoses.items()}


def _spoils_motion(diagnoses: Mapping[tuple[int, int], Diagnosis]) -> bool:
    """Tell whether a cause was found that alters the course of the motion over the lines."""
    codes = {finding.code for found in diagnoses.values() for finding in found.findings}
    return bool(codes & {"mains_lines", "conjugated_laser"})


def _check_determined(motion: RigidMotion) -> None:
    faults = []
    for number, body in enumerate(motion.bodies):
        if not np.any(np.isfinite(motion.q[:, number].real)):
            step = f"Measure more channels at the same frequencies, or fit fewer with {named('dof')}"
            expected = f"measured by channels that determine {', '.join(motion.dof)} at one line at least"
            faults.append(Fault(f"body {body}", expected, "too few channels at every line", "", step))
    raise_all(KinematicsError, faults)


def _far_away(placed: Measurement) -> list[Notice]:
    """Return the warning that the points of the stapes lie where no stapes reaches, as in a foreign frame."""
    for body in placed.bodies:
        distance = float(np.linalg.norm(np.mean(body.positions_mm, axis=0)))
        if body.body == "stapes" and distance > _FARTHEST_MM:
            text = (
                f"the points of body stapes lie {distance:.3g} mm from the footplate centre in the mean, "
                "farther than a stapes reaches: their coordinates look like those of another frame. Tie it "
                f"to the footplate with {named('fiducials')}, or name it with {named('frame')}; the "
                "motion is told about a "
                "point far from the bone."
            )
            return [Notice("far_from_footplate", text)]
    return []


def _body_notices(
    placed: Measurement, run: int, body: BodyChannels, fit: LineFit, diagnosis: Diagnosis, known: bool
) -> list[Notice]:
    several = len(placed.runs) > 1
    where = f" in run {placed.runs[run]}" if several else ""
    notices = fault_notices(placed.runs[run], body, diagnosis, several)
    notices += neglected_notice(fit, body, where)
    if not np.all(fit.solution.good):
        measured = np.any(np.isfinite(body.displacement[run].real), axis=0)
        lost = int(np.sum(~fit.solution.good & measured))
        if lost:
            text = f"body {body.body}{where}: {lost} lines have too few channels to determine the motion."
            notices.append(Notice("lines_undetermined", text))
    if fit.beams.weak:
        text = f"body {body.body}: hardly observable from these beams: {fit.beams.weak}."
        notices.append(Notice("unobservable", text))
    if known and not diagnosis.findings and diagnosis.level > 1.25 and diagnosis.level_matters:
        text = (
            f"body {body.body}{where}: residuals are {np.sqrt(diagnosis.level):.2g} times the stated "
            "noise on all channels alike; check the sd or the number of averages."
        )
        notices.append(Notice("noise_level", text))
    return notices


def _verdicts(
    run_name: str, screen: Screened, run: int, fit: LineFit, found: Diagnosis
) -> list[ChannelVerdict]:
    weight = fit.channel_weight
    weight = weight / max(float(np.max(weight)), 1e-300)
    return channel_verdicts(run_name, screen.body, found, fit.channel_rms, weight, screen.unused[run])


def _motion(
    placed: Measurement, fits: Mapping[tuple[int, int], LineFit], dof: tuple[str, ...]
) -> RigidMotion:
    runs, bodies = range(len(placed.runs)), range(len(placed.bodies))

    def stacked(name: str, dtype: type = float) -> NDArray[Any]:
        made = np.empty((len(runs), len(bodies), *getattr(fits[0, 0], name).shape), dtype=dtype)
        for run, body in product(runs, bodies):
            made[run, body] = getattr(fits[run, body], name)
        return made

    return RigidMotion(
        placed.runs,
        tuple(body.body for body in placed.bodies),
        dof,
        placed.freq_hz,
        stacked("q", complex),
        stacked("covariance", complex),
        stacked("chi2"),
        stacked("n_dof", np.int64),
    )


def _shared(
    placed: Measurement,
    fits: Mapping[tuple[int, int], LineFit],
    placement: Placement,
    motion: RigidMotion,
    calibration: Calibration | None,
) -> SharedErrors | None:
    if calibration is None:
        positions = position_errors(fits, placed.bodies)
        others, spread, slopes = positions.names, np.diag(positions.variances), positions.derivatives
    else:
        others, spread, slopes = calibration_errors(calibration, fits, motion.q.shape)
    count = len(placement.names)
    names = (*placement.names, *others)
    if not names:
        return None
    derivatives = np.zeros((len(names), *motion.q.shape), dtype=complex)
    derivatives[count:] = slopes
    for (run, number), fit in fits.items() if count else ():
        by_pose = pose_derivatives(fit, placed.bodies[number], placement)
        derivatives[:count, run, number] = np.einsum("kp,kfm->pfm", placement.derivative, by_pose)
    covariance = np.zeros((len(names), len(names)))
    covariance[:count, :count] = placement.covariance
    covariance[count:, count:] = spread
    return SharedErrors(names, covariance, derivatives)
