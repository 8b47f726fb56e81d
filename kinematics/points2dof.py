"""From what the beams read to the motion of rigid bodies: the one way of command, study and notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from kinematics.faults.checks import Screened, check_measurement, empty_faults, screen_zeros
from kinematics.faults.correct import Correction, corrected, on_all_bodies
from kinematics.faults.search import Diagnosis, diagnose
from kinematics.faults.verdicts import (
    ChannelVerdict,
    channel_verdicts,
    fault_notices,
    left_out_verdicts,
    points_of_other_bodies,
)
from kinematics.fit.beams import BeamSet, beam_set
from kinematics.fit.few_averages import with_steady_noise
from kinematics.fit.noise import fit_with_noise
from kinematics.fit.reference import parse_reference, per_reference
from kinematics.fit.rigid_fit import LineFit
from kinematics.inputs import read_inputs
from kinematics.joint.expected import body_starts, stated_errors
from kinematics.measurement import BodyChannels, Measurement
from kinematics.motion_checks import check_determined, fit_notices, phase_notices, uncommon_lines
from kinematics.options import MotionOptions
from kinematics.place.errors import ErrorEstimate, agreement, with_errors
from kinematics.place.fiducials import Fiducials
from kinematics.place.handedness import check_positions
from kinematics.place.placement import Placement, place
from kinematics.place.points_on_bone import SurfaceCheck, check_extent, check_surfaces, far_away
from kinematics.place.shared_errors import correction_of, shared_errors
from kinematics.place.surfaces import surfaces_of
from kinematics.repeats import pool_repeats
from kinematics.results import MotionResult
from stapeskit.command import no_progress
from stapeskit.faults import Fault, collect_faults, raise_all
from stapeskit.provenance import frames_hash, record
from stapeskit.records.mass_record import MassRecord
from stapeskit.records.rigid_motion import RigidMotion
from stapeskit.warnings import Notice, once

TYPE_CHECKING = False
if TYPE_CHECKING:
    from stapeskit.command import Progress

USUAL_POSITION_SD_M = 10e-6
"""Error of a position that the search expects where none is stated: half the spot of a laser under a
microscope."""


def measure_motion(
    options: MotionOptions,
    mass: MassRecord | None = None,
    progress: Progress = no_progress,
    command: Sequence[str] | None = None,
    taken: Mapping[str, Path] | None = None,
) -> MotionResult:
    """Read a measurement, tie it to the footplate, fit the motion of its bodies, and look for faults.

    Parameters
    ----------
    taken : mapping of str to Path, optional
        By role: files that were found beside the measurement, for the provenance and the page.

    Raises
    ------
    StapeskitError
        What is wrong with the files, all of it together; frames that nothing ties to the footplate; points
        that do not lie on the bone; beams that cannot observe the degrees of freedom; positions and beams in
        different axes; a body without a usable value.
    """
    progress("reading the measurement")
    measurement, fiducials = read_inputs(options, mass)
    progress("fitting the motion")
    steady = tuple(with_steady_noise(body) for body in measurement.bodies)
    measurement, repeats = pool_repeats(replace(measurement, bodies=steady))
    check_extent(measurement)
    placement = place(fiducials, options.frame or "footplate", mass)
    notices = [] if placement.registration is None else [*placement.registration.notices]
    surfaces = {} if mass is None else surfaces_of(mass)
    checks: tuple[SurfaceCheck, ...] = ()
    if mass is not None:
        checks, found_off = check_surfaces(measurement, placement, mass, surfaces)
        notices += found_off
    placed = measurement.mapped(placement.transform)
    if options.reference:
        parse_reference(options.reference, tuple(body.body for body in placed.bodies), options.dof)
    raise_all(empty_faults(placed))
    screened = [screen_zeros(body, placed.runs, options.dof) for body in placed.bodies]
    notices += [*far_away(placed), *uncommon_lines(placed), *check_measurement(placed)]
    notices += [notice for one in screened for notice in one.notices]
    fitted = _fit(replace(placed, bodies=tuple(one.body for one in screened)), options)
    progress("looking for faults")
    diagnoses = _search(fitted, options)
    found = fitted.placed.bodies
    check_positions(fitted.placed, diagnoses)
    notices += points_of_other_bodies(fitted.placed, fitted.fits, diagnoses)
    notices += [
        notice for number, body in enumerate(found) for notice in fault_notices(body, diagnoses[number])
    ]
    applied: dict[int, Diagnosis] = diagnoses
    corrections: list[Correction] = []
    if options.correct:
        applied = on_all_bodies(found, diagnoses)
        starts, freq_hz = body_starts(found), placed.freq_hz
        corrections = [corrected(body, applied[k], freq_hz, starts[k]) for k, body in enumerate(found)]
        fitted = _fit(replace(fitted.placed, bodies=tuple(one.body for one in corrections)), options)
        notices += [notice for one in corrections for notice in one.notices]
    estimate = agreement(fitted.placed, applied, options.laser_sd, options.calibrate, options.correct)
    if estimate is not None:
        notices += estimate.notices()
        if options.calibrate:
            fitted = _fit(with_errors(fitted.placed, estimate), options)
    notices += [*fitted.notices, *fit_notices(fitted.placed, fitted.fits)]
    motion = _motion(fitted, placement, estimate, corrections)
    check_determined(motion)
    notices += phase_notices(motion, mass)
    if options.reference:
        motion = per_reference(motion, options.reference)
        notices += motion.notices
    before = () if mass is None else mass.notices
    before = tuple(replace(notice, text=f"mass: {notice.text}") for notice in before)
    every = once([*before, *measurement.notices, *notices])
    motion = replace(motion, notices=every, provenance=_provenance(options, fiducials, mass, command, taken))
    return MotionResult(
        motion=motion,
        measurement=fitted.placed,
        placement=placement,
        channels=_verdicts(fitted, found, diagnoses, screened),
        fits=fitted.fits,
        diagnoses=diagnoses,
        checks=checks,
        errors=estimate,
        repeats=repeats,
        mass=mass,
        surfaces=surfaces,
        files=(*options.inputs().values(), *([mass.file] if mass is not None and mass.file else [])),
        taken=dict(taken or {}),
    )


@dataclass(frozen=True)
class _Fitted:
    """The fits of a placed measurement, by (run, body)."""

    placed: Measurement
    fits: dict[tuple[int, int], LineFit]
    notices: tuple[Notice, ...]


def _fit(placed: Measurement, options: MotionOptions) -> _Fitted:
    """Fit every body in every run; one error lists all motions that beams cannot observe."""
    faults: list[Fault] = []
    beams: list[BeamSet] = []
    for body in placed.bodies:
        with collect_faults(faults):
            beams.append(beam_set(body.body, body.arms_m, body.directions, options.dof))
    raise_all(faults)
    fits: dict[tuple[int, int], LineFit] = {}
    notices: list[Notice] = []
    for run, number in product(range(len(placed.runs)), range(len(placed.bodies))):
        found = fit_with_noise(placed, run, placed.bodies[number], beams[number], options.robust)
        fits[run, number] = found[0]
        notices += found[1]
    return _Fitted(placed, fits, once(notices))


def _search(fitted: _Fitted, options: MotionOptions) -> dict[int, Diagnosis]:
    """Look for faults in every body, all of its runs together."""
    placed = fitted.placed
    runs = range(len(placed.runs))
    found = {}
    for number, body in enumerate(placed.bodies):
        usual = np.where(body.position_sd_m >= 0.0, body.position_sd_m, USUAL_POSITION_SD_M)
        found[number] = diagnose(
            body,
            [fitted.fits[run, number] for run in runs],
            placed.freq_hz,
            stated_errors([replace(body, position_sd_m=usual)], options.laser_sd),
            placed.line_spread,
        )
    return found


def _verdicts(
    fitted: _Fitted,
    bodies: Sequence[BodyChannels],
    diagnoses: Mapping[int, Diagnosis],
    screened: Sequence[Screened],
) -> tuple[ChannelVerdict, ...]:
    """Return the verdict of every channel in every run, then those that the user left out."""
    placed = fitted.placed
    verdicts: list[ChannelVerdict] = []
    for run, name in enumerate(placed.runs):
        for number, body in enumerate(bodies):
            fit = fitted.fits[run, number]
            weight = fit.solution.weight / max(float(np.max(fit.solution.weight)), 1e-300)
            unused = screened[number].unused[run]
            verdicts += channel_verdicts(name, body, diagnoses[number], fit.channel_rms_m, weight, unused)
    return (*verdicts, *left_out_verdicts(placed.runs, placed.left_out))


def _motion(
    fitted: _Fitted,
    placement: Placement,
    estimate: ErrorEstimate | None,
    corrections: Sequence[Correction],
) -> RigidMotion:
    """Return the motion of all bodies with its shared errors, corrected by the estimate of them."""
    placed, fits = fitted.placed, fitted.fits
    runs, bodies = range(len(placed.runs)), range(len(placed.bodies))

    def stacked(name: str) -> Any:
        return np.stack([np.stack([getattr(fits[run, body], name) for body in bodies]) for run in runs])

    done = [(one.errors, one.covariance) for one in corrections]
    shared = shared_errors(placed, fits, placement, estimate, done)
    q = stacked("q")
    if estimate is not None and not estimate.calibrated:
        q = q + correction_of(placed, fits, estimate)
    return RigidMotion(
        placed.runs,
        tuple(body.body for body in placed.bodies),
        fits[0, 0].beams.dof,
        placed.freq_hz,
        q,
        stacked("covariance").astype(complex),
        stacked("chi2"),
        stacked("n_dof"),
        shared=shared,
    )


def _provenance(
    options: MotionOptions,
    fiducials: Fiducials | None,
    mass: MassRecord | None,
    command: Sequence[str] | None,
    taken: Mapping[str, Path] | None,
) -> dict[str, Any]:
    inputs: dict[str, Any] = dict(options.inputs())
    if mass is not None:
        inputs["mass"] = mass.provenance_input
    parameters = {**options.parameters(), "frame": options.source_frame}
    if taken:
        parameters["found_beside"] = sorted(taken)
    frames = [options.frame or "footplate"] if fiducials is None else [fiducials.frame]
    block = record(inputs, parameters, command) | {"registered_in": frames}
    return block if mass is None else {**block, "frames_hash": frames_hash(mass.raw)}
