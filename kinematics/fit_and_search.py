"""Fit every body in every run, search the fits for faults, and see whether the lasers explain them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

from kinematics.errors import KinematicsError
from kinematics.faults.adaptation import Correction, corrections_of
from kinematics.faults.diagnose import Diagnosis, search_body, too_large
from kinematics.faults.judges.explain import explain_misfit
from kinematics.faults.judges.row_labels import find_mislabelled
from kinematics.faults.packed_readings import MOST_CHANNELS
from kinematics.faults.screening import Screened
from kinematics.fit.beams import BeamSet, beam_set
from kinematics.fit.body_noise import fit_with_noise
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels, Measurement
from kinematics.registration.laser_errors import Lasers
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.warnings import Notice

# Rounds of correcting and searching again; a search finds several faults itself.
_ROUNDS = 3
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


def beam_sets(placed: Measurement, dof: tuple[str, ...]) -> list[BeamSet]:
    """Factorise every body; raise what any of them cannot observe in one message."""
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
    placed: Measurement, screens: Sequence[Screened], beams: Sequence[BeamSet], robust: str
) -> tuple[SearchedFits, dict[tuple[int, int], LineFit]]:
    """Return the fits of every body in every run, searched by itself, and the fits that the search made."""
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
            notices.append(_unsearched(body))
        diagnoses[key], searched[key] = search_body(placed, run, body, fits[key], known[key])
    return SearchedFits(placed, tuple(screens), fits, known, diagnoses, notices), searched


def _explain(first: SearchedFits, searched: dict[tuple[int, int], LineFit]) -> SearchedFits:
    """Return the fits with wrong labels and causes in place of what they look like to one body's search."""
    placed, known, diagnoses = first.placed, first.known, dict(first.diagnoses)
    # Rows under a wrong label are single values far off, too: the narrower cause is looked for first, and
    # believed unless a body that bends remains.
    exchanged = find_mislabelled(placed, searched, diagnoses, known)
    for key in diagnoses:
        other = None
        if key not in exchanged or exchanged[key].bends:
            body = first.screens[key[1]].body
            other = explain_misfit(placed, key[0], body, searched[key], known[key], diagnoses[key])
        diagnoses[key] = other[0] if other else exchanged.get(key, diagnoses[key])
    return replace(first, diagnoses=diagnoses)


def _unsearched(body: BodyChannels) -> Notice:
    text = (
        f"{body.body}: its {len(body.points)} channels were not searched for faults; the search takes up to "
        f"{MOST_CHANNELS} channels a body, or any number with stated noise and exact positions. Fit "
        "every tenth point, say, and see whether any is at fault."
    )
    return Notice("faults_not_searched", text)


def with_lasers(
    searched: SearchedFits, lasers: Lasers, beams: Sequence[BeamSet], robust: str
) -> SearchedFits | None:
    """Return the fits with the lasers corrected, where that explains all that was found.

    A scatter of the lasers no larger than stated is no fault. None where it is larger, where it leaves
    anything to be found, or where single values or lines are at fault.

    Notes
    -----
    Where the noise is not stated its size comes from the misfit itself, which the lasers add to: they are
    estimated and the noise is fitted in turn, and what is left decides, not by how much the misfit fell.
    """
    codes = {finding.code for diagnosis in searched.diagnoses.values() for finding in diagnosis.findings}
    if searched.clean or codes & _AT_SINGLE_LINES:
        return None
    stated = all(searched.known.values())
    placed, fits, values = searched.placed, searched.fits, None
    for _ in range(1 if stated else _ROUNDS):
        estimate = lasers.estimate(placed, fits, applied=values)
        if not (estimate.explains_misfit if stated else estimate.as_stated):
            return None
        values = estimate.values
        placed = lasers.corrected(searched.placed, values)
        if not stated:
            fits = {
                (run, number): fit_with_noise(placed, run, placed.bodies[number], beams[number], robust)[0]
                for run, number in fits
            }
    screens = [
        replace(screen, body=body) for screen, body in zip(searched.screens, placed.bodies, strict=True)
    ]
    first, fitted = _search(placed, screens, beams, robust)
    if not first.clean:  # whatever explains it, something is found
        return None
    again = _explain(first, fitted)
    return replace(again, applied=values) if again.clean else None


def corrected_fits(
    searched: SearchedFits, dof: tuple[str, ...], robust: str
) -> tuple[SearchedFits, tuple[Correction, ...]]:
    """Return the fits after the faults were corrected that can be, and what was done about each.

    What is corrected is searched again: another fault may have hidden behind it.
    """
    done: list[Correction] = []
    for _ in range(_ROUNDS):
        corrections = corrections_of(searched.placed, searched.fits, searched.diagnoses, done)
        if not corrections:
            break
        done += corrections
        searched = search_again(searched, corrections, dof, robust)
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
