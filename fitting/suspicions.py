"""Is the motion what its file says? Conjugated, reversed, exchanged, rotations in degrees: quick checks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fitting.data import Data
from fitting.likelihood import LOAD, PLAIN, Likelihood, Model
from fitting.solve import best_start, degrees, minimise
from stapeskit.spatial import DOF_NAMES
from stapeskit.warnings import Notice

# Chi2 per degree of freedom of K, D >= 0 without shared errors from which another reading is tried, and the
# share of it below which that reading is reported: a right reading explains a hundred times more.
_BAD, _BETTER = 4.0, 0.2
# Geometric mean of rotation times 1 mm over displacement of both bodies: up to 2.2 for ears and shakers in
# radians (rocking at resonance 5, base rocking 1), in degrees 57 times as much of 0.15 or more.
_DEGREES = 6.0


def suspicions(data: Data, law: str) -> list[Notice]:
    """Return warnings about a motion that fits its equations only when it is read otherwise."""
    notices = _degrees(data)
    model = Model(law if law != "compare" else "viscous", LOAD if data.loads_known else PLAIN)
    bare = data.without_errors()
    own = _level(bare, model)
    if own < _BAD:
        return notices
    m = len(data.measured)
    order = np.r_[m : 2 * m, :m]
    sign = np.r_[np.ones(m), -np.ones(m)]
    readings = (
        (
            "phase_convention",
            replace(bare, y=bare.y.conj(), covariance=bare.covariance.conj()),
            "The phases look like those of amplitudes of e^{-iwt}: the conjugate motion fits",
            "Conjugate the motion, or state the convention to points2dof",
        ),
        (
            "phase_convention",
            replace(bare, y=bare.y * sign, covariance=bare.covariance * np.outer(sign, sign)),
            "Structure and base look read in opposite senses: the motion fits with one of them reversed",
            "Reverse the sign of all readings of the body whose directions point the wrong way",
        ),
        (
            "bodies_exchanged",
            replace(bare, y=bare.y[:, order], covariance=bare.covariance[:, order][:, :, order]),
            "Structure and base look exchanged: the motion fits with their names swapped",
            "Exchange the names of the bodies, or --structure and --base",
        ),
    )
    levels = [_level(reading, model) for _, reading, _, _ in readings]
    best = int(np.argmin(levels))
    if levels[best] < _BETTER * own:
        code, _, meaning, step = readings[best]
        text = f"{meaning} with chi2 per degree of freedom {levels[best]:.3g} instead of {own:.3g}. {step}."
        notices.append(Notice(code, text))
    return notices


def _level(data: Data, model: Model) -> float:
    """Return chi2 per degree of freedom of a quick fit; infinite where there is none."""
    likelihood = Likelihood(data, model)
    try:
        _, chi2, _, _ = minimise(likelihood, best_start(likelihood), 1e-3, 20)
    except np.linalg.LinAlgError:
        return float("inf")
    return chi2 / max(degrees(likelihood), 1)


def _degrees(data: Data) -> list[Notice]:
    m = len(data.measured)
    size = np.sqrt(np.mean(np.abs(data.y) ** 2, axis=0)) / np.tile(data.root_mass, 2)
    turns = [place for place, name in enumerate(data.measured) if name in DOF_NAMES[3:]]
    moves = [place for place, name in enumerate(data.measured) if name in DOF_NAMES[:3]]
    if not turns or not moves:
        return []
    ratios = [
        1e-3 * np.linalg.norm(size[[body * m + place for place in turns]])
        / max(float(np.linalg.norm(size[[body * m + place for place in moves]])), 1e-300)
        for body in (0, 1)
    ]  # fmt: skip
    if np.sqrt(ratios[0] * ratios[1]) < _DEGREES:
        return []
    text = (
        f"Rotations times 1 mm are {ratios[0]:.3g} (structure) and {ratios[1]:.3g} (base) times the "
        "displacements: they look like degrees. Write them in radians."
    )
    return [Notice("unit_slip", text)]
