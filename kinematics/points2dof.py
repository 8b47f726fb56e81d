"""From what the beams read to the motion of rigid bodies about the footplate centre: one library call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.errors import KinematicsError
from kinematics.faults.across.lines import exchanged_lines
from kinematics.faults.across.phase import phase_notice
from kinematics.faults.adaptation import Correction, correction_notices, shown
from kinematics.faults.diagnose import Diagnosis
from kinematics.faults.screening import Screened, empty_faults, is_whole, screened
from kinematics.faults.unit_slips import unit_slips
from kinematics.faults.verdicts import ChannelVerdict, channel_verdicts, fault_notices
from kinematics.fit.beams import unseen_motions
from kinematics.fit.frf_ratio import parse_reference, per_reference
from kinematics.fit.neglected_motion import neglected_notice
from kinematics.fit.reference_noise import with_record_noise
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels, Measurement
from kinematics.motion_checks import check_determined, far_away, uncommon_lines
from kinematics.options import LdvOptions
from kinematics.registration.calibrate import Calibration
from kinematics.registration.calibrated_fit import calibrated
from kinematics.registration.correction_errors import with_corrections
from kinematics.registration.geometry_model import GeometryPriors
from kinematics.registration.handedness import check_axes
from kinematics.registration.laser_notices import channels_at_fault, laser_notices
from kinematics.registration.lasers import LaserErrors, LaserPriors, Lasers
from kinematics.registration.motion_errors import motion_errors
from kinematics.registration.placement import Placement, place
from kinematics.repeats.comparison import RunRepeats
from kinematics.repeats.pooling import pooled, separate, with_gain_errors
from kinematics.searched_fits import beam_sets, corrected_fits, searched_fits, with_lasers
from stapeskit.faults import Fault, raise_all
from stapeskit.records.mass_record import MassRecord
from stapeskit.records.motion import RigidMotion
from stapeskit.spatial import DOF_NAMES
from stapeskit.warnings import Notice, unique

Array = NDArray[np.float64]
ROBUST = ("none", "huber", "t4")
REPEATS = ("pool", "separate")


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
    lasers : LaserPriors
        How well gain, phase and delay of the lasers agree.
    correct : bool
        Correct the faults that are identified by their estimates.

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
    lasers: LaserPriors = field(default_factory=LaserPriors)
    correct: bool = False

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

    @property
    def laser_priors(self) -> LaserPriors:
        """The priors of the lasers without the gain where a calibration estimates that."""
        return self.lasers if self.calibrate is None else replace(self.lasers, gain_sd_percent=0.0)


def fit_options(options: LdvOptions) -> Options:
    """Return the choices of the fit out of the options of the command or of a study."""
    usual = GeometryPriors()
    priors = GeometryPriors(
        usual.axes_sd_deg if options.axes_sd_deg is None else options.axes_sd_deg,
        usual.beam_sd_deg if options.beam_sd_deg is None else options.beam_sd_deg,
        options.gain_sd_percent,
    )
    return Options(
        options.dof,
        options.reference,
        options.robust,
        priors if options.calibrate else None,
        options.repeats,
        options.reference_noise,
        LaserPriors(options.gain_sd_percent, options.phase_sd_deg, options.delay_sd_us),
        options.correct,
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
    lasers : LaserErrors or None
        How far the lasers agree, unless they do so exactly.
    corrections : tuple of Correction
        What was done about faults, when that was asked for.
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
    lasers: LaserErrors | None = None
    corrections: tuple[Correction, ...] = ()

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
    beams = beam_sets(placed, options.dof)
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
        beams = beam_sets(placed, options.dof)
    lasers = Lasers.of(placed, options.laser_priors)
    found = searched_fits(placed, screens, beams, options.robust)
    if lasers is not None:
        found = with_lasers(found, lasers, beams, options.robust) or found
    corrections: tuple[Correction, ...] = ()
    if options.correct and not found.clean:
        found, corrections = corrected_fits(found, options.dof, options.robust)
    placed, screens, fits, known = found.placed, list(found.screens), found.fits, found.known
    diagnoses = found.diagnoses
    reported = shown(corrections, diagnoses)
    verdicts: list[ChannelVerdict] = []
    notices = [*measurement.notices, *placement.notices, *slips]
    notices += [] if calibration is None else calibration.notices
    for screen in screens:
        notices += screen.notices
    notices += [] if whole else uncommon_lines(placed)
    notices += [*far_away(placed), *found.notices, *correction_notices(placed, corrections)]
    for run in range(len(placed.runs)):
        for number, screen in enumerate(screens):
            key = (run, number)
            notices += _body_notices(placed, run, screen.body, fits[key], diagnoses[key], known[key])
            verdicts += _verdicts(placed.runs[run], screen, run, fits[key], reported[key])
    notices += check_axes(placed, placement.transform, fits, _left_by_one(diagnoses))
    motion = with_record_noise(_motion(placed, fits, options.dof), placed, fits)
    check_determined(motion)
    errors = None
    if lasers is not None:
        estimate = lasers.estimate(placed, fits, channels_at_fault(diagnoses), found.applied)
        if estimate.beyond_belief:
            estimate = lasers.estimate(placed, fits, {}, found.applied)
        errors = lasers.errors(placed, fits, estimate)
        motion = replace(motion, q=motion.q + errors.correction)
        notices += laser_notices(errors)
    motion = replace(
        motion,
        shared=motion_errors(placed, fits, placement, errors, calibration),
        provenance=dict(provenance or {}),
    )
    motion = with_corrections(motion, placed, fits, corrections)
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
        errors,
        corrections,
    )


def _left_by_one(diagnoses: Mapping[tuple[int, int], Diagnosis]) -> dict[tuple[int, int], float]:
    """Return the share of each misfit that a single fault, other than of all beams, does not explain."""
    return {key: found.kept for key, found in diagnoses.items()}


def _spoils_motion(diagnoses: Mapping[tuple[int, int], Diagnosis]) -> bool:
    """Tell whether a cause was found that alters the course of the motion over the lines."""
    codes = {finding.code for diagnosis in diagnoses.values() for finding in diagnosis.findings}
    return bool(codes & {"mains_lines", "conjugated_laser"})


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
