"""From what the beams read to the motion of rigid bodies about the footplate centre: one library call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.faults.adaptation import Correction, correction_notices, shown
from legacy.kinematics.faults.diagnosis import Diagnosis
from legacy.kinematics.faults.judges.line_order import order_notices, put_in_order, reordered_bodies
from legacy.kinematics.faults.judges.phase_convention import phase_notice
from legacy.kinematics.faults.verdicts import ChannelVerdict, channel_verdicts, fault_notices
from legacy.kinematics.fit.beams import unseen_motions
from legacy.kinematics.fit.frf_ratio import parse_reference, per_reference
from legacy.kinematics.fit.neglected_motion import neglected_notice
from legacy.kinematics.fit.reference_noise import with_record_noise
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.fit_and_search import (
    SearchedFits,
    corrected_fits,
    fit_and_search,
    search_again,
    with_lasers,
)
from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.motion_checks import check_determined, far_away
from legacy.kinematics.prepared_measurement import PreparedMeasurement, prepare_measurement
from legacy.kinematics.registration.calibrate import Calibration
from legacy.kinematics.registration.correction_errors import with_corrections
from legacy.kinematics.registration.handedness import check_axes
from legacy.kinematics.registration.laser_errors import LaserErrors, Lasers
from legacy.kinematics.registration.laser_notices import channels_at_fault, laser_notices
from legacy.kinematics.registration.motion_errors import motion_errors
from legacy.kinematics.registration.placement import Placement, place
from legacy.kinematics.repeats.comparison import RunRepeats
from legacy.kinematics.repeats.pooling import with_gain_errors
from legacy.stapeskit.records.mass_record import MassRecord
from legacy.stapeskit.records.motion import STORED, RigidMotion, RowColumn
from legacy.stapeskit.warnings import Notice, unique


@dataclass(frozen=True)
class Points2Dof:
    """The result.

    Attributes
    ----------
    motion : RigidMotion
        With covariance, shared errors and all notices.
    measurement : Measurement
        In the footplate frame.
    fits : mapping of (run, body) to LineFit
        By position.
    diagnoses : mapping of (run, body) to Diagnosis
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
    ready = prepare_measurement(measurement, placement, options)
    lasers = Lasers.of(ready.placed, options.laser_priors)
    searched, corrections = _search(ready, lasers, options)
    diagnoses = searched.diagnoses
    notices = [*ready.notices, *far_away(searched.placed), *searched.notices]
    notices += [*correction_notices(searched.placed, corrections), *_notices_of_bodies(searched)]
    unexplained = {key: diagnosis.kept for key, diagnosis in diagnoses.items()}
    notices += check_axes(searched.placed, placement.transform, searched.fits, unexplained)
    motion = with_record_noise(
        _motion(searched.placed, searched.fits, options.dof), searched.placed, searched.fits
    )
    check_determined(motion)
    errors = None if lasers is None else _laser_errors(lasers, searched)
    if errors is not None:
        motion = replace(motion, q=motion.q + errors.correction)
        notices += laser_notices(errors)
    motion = replace(
        motion,
        shared=motion_errors(searched.placed, searched.fits, placement, errors, ready.calibration),
        provenance=dict(provenance or {}),
    )
    motion = with_corrections(motion, searched.placed, searched.fits, corrections)
    motion = with_gain_errors(motion, ready.repeats.repeats if options.repeats == "pool" else ())
    if not _spoils_motion(diagnoses):
        derivatives = searched.placed.order
        reordered = reordered_bodies(motion, derivatives)
        right = put_in_order(motion, reordered, derivatives)
        notices += order_notices(motion, reordered) + phase_notice(
            right, mass, derivatives, rigid=not any(found.bends for found in diagnoses.values())
        )
    if options.reference:
        motion = per_reference(motion, options.reference)
        notices += motion.notices
    else:
        motion = _with_reference_noise(motion, options, ready.repeats.measurement)
    bodies = searched.placed.bodies
    return Points2Dof(
        replace(motion, notices=unique(notices)),
        _verdicts(searched, shown(corrections, diagnoses)),
        searched.placed,
        placement,
        searched.fits,
        diagnoses,
        options,
        {body.body: tuple(unseen_motions(body.positions_mm, body.directions)) for body in bodies},
        ready.calibration,
        ready.repeats.repeats,
        errors,
        corrections,
    )


def _search(
    ready: PreparedMeasurement, lasers: Lasers | None, options: Options
) -> tuple[SearchedFits, tuple[Correction, ...]]:
    """Return the fits with their faults, and the corrections made."""
    searched = fit_and_search(ready.placed, ready.screens, ready.beams, options.robust)
    if lasers is not None:
        searched = with_lasers(searched, lasers, ready.beams, options.robust) or searched
    if not options.correct:
        return searched, ()
    corrections: tuple[Correction, ...] = ()
    if not searched.clean:
        searched, corrections = corrected_fits(searched, lasers, options.dof, options.robust)
    if not _spoils_motion(searched.diagnoses):
        motion = _motion(searched.placed, searched.fits, options.dof)
        reordered = reordered_bodies(motion, searched.placed.order)
        of_bodies = [body.correction(searched.placed) for body in reordered]
        if of_bodies:
            searched = search_again(searched, of_bodies, options.dof, options.robust)
        corrections += tuple(of_bodies)
    return searched, corrections


def _laser_errors(lasers: Lasers, searched: SearchedFits) -> LaserErrors:
    """Estimate how far the lasers disagree, without channels at fault unless that is beyond belief."""
    left_out = channels_at_fault(searched.diagnoses)
    estimate = lasers.estimate(searched.placed, searched.fits, left_out, searched.applied)
    if estimate.beyond_belief:
        estimate = lasers.estimate(searched.placed, searched.fits, {}, searched.applied)
    return lasers.errors(searched.placed, searched.fits, estimate)


def _with_reference_noise(motion: RigidMotion, options: Options, measurement: Measurement) -> RigidMotion:
    """Return the motion with the noise of the signal that all readings refer to in its covariance."""
    if options.reference_noise == 0.0 and measurement.common_sd is None:
        return motion
    measured = 0.0 if measurement.common_sd is None else measurement.common_sd
    return motion.with_common_noise(np.hypot(options.reference_noise, measured))


def _spoils_motion(diagnoses: Mapping[tuple[int, int], Diagnosis]) -> bool:
    """Return whether a cause was found that changes the motion differently from line to line."""
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


def _notices_of_bodies(searched: SearchedFits) -> list[Notice]:
    """Return the warnings of the fits of all bodies and runs."""
    notices: list[Notice] = []
    for run, (number, screen) in product(range(len(searched.placed.runs)), enumerate(searched.screens)):
        key = (run, number)
        notices += _body_notices(
            searched.placed,
            run,
            screen.body,
            searched.fits[key],
            searched.diagnoses[key],
            searched.known[key],
        )
    return notices


def _verdicts(
    searched: SearchedFits, reported: Mapping[tuple[int, int], Diagnosis]
) -> tuple[ChannelVerdict, ...]:
    """Return the verdict on every channel in every run."""
    verdicts: list[ChannelVerdict] = []
    for run, (number, screen) in product(range(len(searched.placed.runs)), enumerate(searched.screens)):
        fit, name = searched.fits[run, number], searched.placed.runs[run]
        weight = fit.channel_weight / max(float(np.max(fit.channel_weight)), 1e-300)
        verdicts += channel_verdicts(
            name, screen.body, reported[run, number], fit.channel_rms, weight, screen.unused[run]
        )
    return tuple(verdicts)


def _motion(
    placed: Measurement, fits: Mapping[tuple[int, int], LineFit], dof: tuple[str, ...]
) -> RigidMotion:
    runs, bodies = range(len(placed.runs)), range(len(placed.bodies))

    def stacked(name: str, dtype: type = float) -> NDArray[Any]:
        values = np.empty((len(runs), len(bodies), *getattr(fits[0, 0], name).shape), dtype=dtype)
        for run, body in product(runs, bodies):
            values[run, body] = getattr(fits[run, body], name)
        return values

    def is_known(column: RowColumn) -> bool:
        return not column.optional or all(getattr(fit, column.name) is not None for fit in fits.values())

    rows: dict[str, Any] = {
        column.name: stacked(column.name, np.int64 if column.whole else float) if is_known(column) else None
        for column in STORED
    }
    return RigidMotion(
        placed.runs,
        tuple(body.body for body in placed.bodies),
        dof,
        placed.freq_hz,
        stacked("q", complex),
        stacked("covariance", complex),
        **rows,
    )
