"""Fit every body in every run, search the fits for faults, and see whether the lasers explain them all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.faults.adaptation import Correction, corrections_of
from legacy.kinematics.faults.body_search import search_body
from legacy.kinematics.faults.catalogue import OF_MANY
from legacy.kinematics.faults.diagnose import NEXT, most_findings, too_large
from legacy.kinematics.faults.diagnosis import Diagnosis
from legacy.kinematics.faults.findings import Finding
from legacy.kinematics.faults.judges.explain import explain_misfit
from legacy.kinematics.faults.judges.row_labels import find_mislabelled
from legacy.kinematics.faults.packed_readings import MOST_CHANNELS
from legacy.kinematics.faults.screening import Screened
from legacy.kinematics.fit.beams import BeamSet, beam_set
from legacy.kinematics.fit.body_noise import fit_with_noise
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.registration.laser_errors import Lasers
from legacy.kinematics.registration.laser_estimate import WORTH_CORRECTING
from legacy.kinematics.registration.laser_notices import channels_at_fault
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, StapeskitError, raise_all
from legacy.stapeskit.warnings import Notice

# Rounds of correcting and searching again; a search finds several faults itself.
_ROUNDS = 3
# Standard deviations within which 95 % of what is assumed of lasers lies.
_USUAL_SD = 2.0
# Causes at single values or lines, which no error of a laser resembles: it is smooth over frequency.
_AT_SINGLE_LINES = {"sparse_outliers", "mains_lines"}


@dataclass(frozen=True)
class SearchedFits:
    """The fits of a measurement and what is wrong with them, by (run, body).

    Attributes
    ----------
    placed : Measurement
        As fitted.
    screens : tuple of Screened
        By body; with the channels as fitted.
    known : dict of bool
        Whether the noise is stated.
    notices : list of Notice
        Of the fits.
    applied : ndarray, (p,), or None
        Errors of the lasers that the readings were freed of.
    """

    placed: Measurement
    screens: tuple[Screened, ...]
    fits: dict[tuple[int, int], LineFit]
    known: dict[tuple[int, int], bool]
    diagnoses: dict[tuple[int, int], Diagnosis]
    notices: list[Notice]
    applied: Array | None = None

    @property
    def clean(self) -> bool:
        """Whether nothing was found."""
        return not any(diagnosis.findings for diagnosis in self.diagnoses.values())

    @property
    def unexplained(self) -> int:
        """Number of findings; a body that bends, which explains any misfit, counts as more than are named."""
        return sum(
            1 + most_findings(self.screens[number].body) if diagnosis.bends else len(diagnosis.findings)
            for (_run, number), diagnosis in self.diagnoses.items()
        )


def beam_sets(placed: Measurement, dof: tuple[str, ...]) -> list[BeamSet]:
    """Factorise the beams of every body; one error lists all motions that they cannot observe."""
    beam_sets: list[BeamSet] = []
    faults: list[Fault] = []
    for body in placed.bodies:
        try:
            beam_sets.append(beam_set(body.body, body.positions_mm, body.directions, dof))
        except StapeskitError as fault:
            faults += fault.faults
    raise_all(KinematicsError, faults)
    return beam_sets


def fit_and_search(
    placed: Measurement, screens: Sequence[Screened], beams: Sequence[BeamSet], robust: str
) -> SearchedFits:
    """Fit every body in every run, and search the fits for faults.

    Parameters
    ----------
    placed : Measurement
        In the footplate frame.
    screens : sequence of Screened
        By body.
    beams : sequence of BeamSet
        By body.
    """
    return _explain(*_search(placed, screens, beams, robust))


def _search(
    placed: Measurement,
    screens: Sequence[Screened],
    beams: Sequence[BeamSet],
    robust: str,
    lasers: Lasers | None = None,
    most: int | None = None,
) -> tuple[SearchedFits, dict[tuple[int, int], LineFit]]:
    """Return the fits of every body in every run, searched by itself, and the fits that the search made.

    With ``lasers`` faults are sought next to their scatter; ``most`` as of ``diagnose``.
    """
    fits: dict[tuple[int, int], LineFit] = {}
    searched: dict[tuple[int, int], LineFit] = {}
    known: dict[tuple[int, int], bool] = {}
    diagnoses: dict[tuple[int, int], Diagnosis] = {}
    notices: list[Notice] = []
    for key in product(range(len(placed.runs)), range(len(screens))):
        run, body = key[0], screens[key[1]].body
        fits[key], known[key], raised = fit_with_noise(placed, run, body, beams[key[1]], robust)
        notices += raised
        if too_large(body, known[key]):
            notices.append(_not_searched_notice(body))
        scatter = None if lasers is None else lasers.scatter(key[1])
        diagnoses[key], searched[key] = search_body(placed, run, body, fits[key], known[key], scatter, most)
    return SearchedFits(placed, tuple(screens), fits, known, diagnoses, notices), searched


def _explain(
    first: SearchedFits, searched: dict[tuple[int, int], LineFit], lasers: Lasers | None = None
) -> SearchedFits:
    """Return the fits with wrong labels and causes in place of what they look like to one body's search."""
    placed, known, diagnoses = first.placed, first.known, dict(first.diagnoses)
    fits, notices = dict(first.fits), list(first.notices)
    # Rows under a wrong label are single values far off, too: the narrower cause is looked for first, and
    # believed unless a body that bends remains.
    exchanged = find_mislabelled(placed, searched, diagnoses, known)
    for key in diagnoses:
        other = None
        if key not in exchanged or exchanged[key].bends:
            body = first.screens[key[1]].body
            scatter = None if lasers is None else lasers.scatter(key[1])
            other = explain_misfit(placed, key[0], body, searched[key], known[key], diagnoses[key], scatter)
        diagnoses[key] = other[0] if other else exchanged.get(key, diagnoses[key])
        if other and not other[0].findings:  # no fault but another noise, which the motion is fitted with
            fits[key] = other[1]
            notices.append(_proportional_notice(placed, key))
    return replace(first, fits=fits, diagnoses=diagnoses, notices=notices)


def _proportional_notice(placed: Measurement, key: tuple[int, int]) -> Notice:
    where = f" in run {placed.runs[key[0]]}" if len(placed.runs) > 1 else ""
    text = (
        f"the noise of body {placed.bodies[key[1]].body}{where} was taken as in proportion to each reading: "
        "that is likelier than noise that is alike at all readings of a line. Give sd if it is not."
    )
    return Notice("noise_estimated", text)


def _not_searched_notice(body: BodyChannels) -> Notice:
    text = (
        f"{body.body}: its {len(body.points)} channels were not searched for faults; the search takes up to "
        f"{MOST_CHANNELS} channels a body, or any number with stated noise and exact positions. Fit "
        "every tenth point, say, and see whether any is at fault."
    )
    return Notice("faults_not_searched", text)


def with_lasers(
    searched: SearchedFits, lasers: Lasers, beams: Sequence[BeamSet], robust: str
) -> SearchedFits | None:
    """Return the fits with the lasers corrected, where that explains what was found, or part of it.

    A scatter of the lasers no larger than stated is no fault. None where it is larger, or where no less
    remains to be explained.

    Notes
    -----
    Next to a fault of something else the lasers are estimated without the channels at fault, and what remains
    of it is named with the lasers corrected: their scatter would be blamed on lasers, or on its neighbours.
    """
    if searched.clean:
        return None
    codes = {finding.code for diagnosis in searched.diagnoses.values() for finding in diagnosis.findings}
    if not codes & _AT_SINGLE_LINES:
        again = _freed_of_lasers(searched, lasers, beams, robust)
        if again is not None:
            return again
    if searched.unexplained < 2 or _are_alike(searched, lasers):  # less would be nothing
        return None
    next_to = _explain(*_search(searched.placed, searched.screens, beams, robust, lasers), lasers)
    again = _freed_of_lasers(searched, lasers, beams, robust, next_to)
    return None if again is None or _scatters(again, lasers) else again


def _are_alike(searched: SearchedFits, lasers: Lasers) -> bool:
    """Return whether nothing shows of errors of lasers without the channels at fault."""
    left_out = channels_at_fault(searched.diagnoses)
    if len(left_out) < len(searched.fits):
        return False
    estimate = lasers.estimate(searched.placed, searched.fits, left_out)
    return estimate.fall < WORTH_CORRECTING


def _scatters(searched: SearchedFits, lasers: Lasers) -> bool:
    """Return whether a factor that was found is one as lasers scatter by: many channels may scatter so."""
    most = _USUAL_SD * lasers.prior_sd.get("laser_gain", 0.0)
    return any(
        finding.kind == "gain"
        and (np.linalg.norm(finding.parameters) if finding.fault else finding.size) < most
        for diagnosis in searched.diagnoses.values()
        for finding in diagnosis.findings
    )


def _freed_of_lasers(
    searched: SearchedFits,
    lasers: Lasers,
    beams: Sequence[BeamSet],
    robust: str,
    next_to: SearchedFits | None = None,
) -> SearchedFits | None:
    """Return the fits with the lasers corrected by an estimate that is as stated, searched again.

    None unless less remains than was found: nothing, or, next to the faults of ``next_to``, less.

    Notes
    -----
    Where the noise is not stated its size comes from the misfit itself, which the lasers add to: they are
    estimated and the noise is fitted in turn, and what is left decides, not by how much the misfit fell.
    """
    stated = all(searched.known.values())
    sound, left_out, own = searched.placed, None, beams
    if next_to is not None:
        sound, left_out = _without_faults(next_to)
        own = beam_sets(sound, beams[0].dof)
    placed, fits, alone = sound, searched.fits, next_to is None
    values: Array | None = None
    for turn in range(1 if stated else _ROUNDS):
        if turn or next_to is not None:
            fits = _fitted(placed, left_out or {}, fits, own, robust)
        estimate = lasers.estimate(placed, fits, left_out, values)
        share = 1.0 if alone else NEXT
        if not (estimate.explains_misfit if stated and alone else estimate.is_as_stated(share)):
            return None
        values = estimate.values
        if not np.any(values):  # no body is sound enough to show them
            return None
        placed = lasers.corrected(sound, values)
    if sound is not searched.placed:
        placed = lasers.corrected(searched.placed, estimate.values)
    screens = [
        replace(screen, body=body) for screen, body in zip(searched.screens, placed.bodies, strict=True)
    ]
    # What is left of the errors of the lasers next to faults is no fault either.
    rest = None if alone else lasers
    first, fitted = _search(placed, screens, beams, robust, rest, 0 if alone else None)
    if alone and not first.clean:  # whatever explains it, something is found
        return None
    again = replace(_explain(first, fitted, rest), applied=values)
    return again if again.unexplained < (1 if alone else searched.unexplained) else None


def _without_faults(searched: SearchedFits) -> tuple[Measurement, dict[tuple[int, int], list[int]]]:
    """Return the measurement freed of faults, and the channels of the others.

    Faults of whole lasers and those without a size, as an exchange of names, can be undone; channels with
    others are left out instead, as the errors of their sizes would be taken for errors of lasers.
    """
    sound = searched.placed

    def found(undone: bool) -> dict[tuple[int, int], Diagnosis]:
        return {
            key: replace(
                diagnosis,
                findings=tuple(
                    replace(finding, rivals=())
                    for finding in diagnosis.findings
                    if _is_undone(finding) == undone
                ),
            )
            for key, diagnosis in searched.diagnoses.items()
        }

    for correction in corrections_of(sound, searched.fits, found(undone=True)):
        sound = correction.corrected(sound)
    return sound, channels_at_fault(found(undone=False))


def _is_undone(finding: Finding) -> bool:
    fault = finding.fault
    if fault is None:
        return finding.remedied is not None
    return fault.owner in OF_MANY or not (fault.size or finding.rivals)


def _fitted(
    placed: Measurement,
    left_out: Mapping[tuple[int, int], Sequence[int]],
    keys: Iterable[tuple[int, int]],
    beams: Sequence[BeamSet],
    robust: str,
) -> dict[tuple[int, int], LineFit]:
    """Return the fits, with the noise that they show, without some channels."""
    fits = {}
    for run, number in keys:
        body = placed.bodies[number]
        displacement = body.displacement.copy()
        displacement[run, list(left_out.get((run, number), ()))] = np.nan
        body = replace(body, displacement=displacement)
        fits[run, number] = fit_with_noise(placed, run, body, beams[number], robust)[0]
    return fits


def corrected_fits(
    searched: SearchedFits, lasers: Lasers | None, dof: tuple[str, ...], robust: str
) -> tuple[SearchedFits, tuple[Correction, ...]]:
    """Return the fits after the faults were corrected that can be, and what was done about each.

    What is corrected is searched again: another fault, or a scatter of the lasers, may have hidden behind it.
    """
    done: list[Correction] = []
    for _ in range(_ROUNDS):
        corrections = corrections_of(searched.placed, searched.fits, searched.diagnoses, done)
        if not corrections:
            break
        done += corrections
        searched = search_again(searched, corrections, dof, robust)
        if lasers is not None and searched.applied is None:
            beams = beam_sets(searched.placed, dof)
            searched = with_lasers(searched, lasers, beams, robust) or searched
    return searched, tuple(done)


def search_again(
    searched: SearchedFits, corrections: Sequence[Correction], dof: tuple[str, ...], robust: str
) -> SearchedFits:
    """Return the fits of a measurement after some corrections, and what is wrong with them."""
    placed = searched.placed
    for correction in corrections:
        placed = correction.corrected(placed)
    screens = [
        replace(screen, body=body) for screen, body in zip(searched.screens, placed.bodies, strict=True)
    ]
    again = fit_and_search(placed, screens, beam_sets(placed, dof), robust)
    return replace(again, applied=searched.applied)
