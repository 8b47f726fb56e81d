"""Is the motion what its file says? Conjugated, reversed, exchanged, rotations in degrees: quick checks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtrc

from fitting.data import Data
from fitting.likelihood import LOAD, PLAIN, Likelihood, Model
from fitting.options import COMPARE
from fitting.solve import MISFIT_P, best_start, degrees, minimise
from stapeskit.spatial import DOF_NAMES
from stapeskit.warnings import Notice

# Chi2 per degree of freedom of K, D >= 0 without shared errors from which another reading is tried, and the
# share of it below which that reading is reported: a right reading explains a hundred times more.
_BAD, _BETTER = 4.0, 0.2
_DECISIVE = 50.0  # fall of chi2 from which one of two readings is sure: odds e^25
# Geometric mean of rotation times 1 mm over displacement of both bodies: up to 2.2 for ears and shakers in
# radians (rocking at resonance 5, base rocking 1), in degrees 57 times as much of 0.15 or more.
_DEGREES = 6.0


def suspicions(data: Data, law: str) -> list[Notice]:
    """Return warnings about a motion that fits its equations only when it is read otherwise."""
    notices = _degrees_by_size(data)
    model = Model(law if law != COMPARE else "viscous", LOAD if data.loads_known else PLAIN)
    bare = data.without_errors()
    own = _level(bare, model)
    if not notices and own > 1.0:
        notices = _degrees_by_fit(bare, model, own)
    if notices or own < _BAD:
        return notices
    sign = np.repeat([1.0, -1.0], len(data.measured))
    order = np.roll(np.arange(len(sign)), len(data.measured))
    other = bare.covariance[:, order][:, :, order]
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
            replace(bare, y=bare.y[:, order], covariance=other),
            "Structure and base look exchanged: the motion fits with their names swapped",
            "Exchange the names of the bodies, or --structure and --base",
        ),
    )
    level, code, meaning, step = min(
        (_level(reading, model), code, meaning, step) for code, reading, meaning, step in readings
    )
    if level < _BETTER * own:
        text = f"{meaning} with chi2 per degree of freedom {level:.3g} instead of {own:.3g}. {step}."
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


def _degrees_by_fit(data: Data, model: Model, own: float) -> list[Notice]:
    """Report rotations in degrees by the fit, which couples them to displacements."""
    turned = np.array([name in DOF_NAMES[3:] for name in data.measured] * 2)
    if np.all(turned) or not np.any(turned):
        return []
    scale = np.where(turned, np.radians(1.0), 1.0)
    read = replace(data, y=data.y * scale, covariance=data.covariance * np.outer(scale, scale))
    level, n_dof = _level(read, model), degrees(Likelihood(data, model))
    explained = chdtrc(n_dof, n_dof * level) > MISFIT_P > chdtrc(n_dof, n_dof * own)
    if not explained or n_dof * (own - level) < _DECISIVE:
        return []
    text = f"in radians the motion fits with chi2 per degree of freedom {level:.3g} instead of {own:.3g}"
    return [Notice("unit_slip", f"Rotations look like degrees: {text}. Write them in radians.")]


def _degrees_by_size(data: Data) -> list[Notice]:
    turned = np.array([name in DOF_NAMES[3:] for name in data.measured])
    if np.all(turned) or not np.any(turned):
        return []
    size = (np.sqrt(np.mean(np.abs(data.y) ** 2, axis=0)) / np.tile(data.root_mass, 2)).reshape(2, -1)
    moved = np.maximum(np.linalg.norm(size[:, ~turned], axis=1), 1e-300)
    first, second = 1e-3 * np.linalg.norm(size[:, turned], axis=1) / moved
    if np.sqrt(first * second) < _DEGREES:
        return []
    text = (
        f"Rotations times 1 mm are {first:.3g} (structure) and {second:.3g} (base) times the "
        "displacements: they look like degrees. Write them in radians."
    )
    return [Notice("unit_slip", text)]
