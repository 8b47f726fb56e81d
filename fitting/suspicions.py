"""Is the motion what its file says? Conjugated, reversed, exchanged, in other units: quick fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtrc

from fitting.data import Data
from fitting.likelihood import LOAD, PLAIN, Likelihood, Model
from fitting.options import COMPARE, KDOptions
from fitting.solve import MISFIT_P, best_start, degrees, minimise
from stapeskit.arrays import Array
from stapeskit.spatial import DOF_NAMES, dof_indices
from stapeskit.warnings import Notice

# Chi2 per degree of freedom of K, D >= 0 without shared errors from which every reading is tried, and the
# share of it below which one is reported: a right reading explains a hundred times more.
_BAD, _BETTER = 4.0, 0.2
_UNITS = 25.0  # chi2 per degree of freedom that shared errors leave in the right units; outliers leave more
_SURE = 1.5  # the same of readings that errors of M look like: those leave more
_DECISIVE = 50.0  # fall of chi2 from which one of two readings is sure: odds e^25
# Geometric mean of rotation times 1 mm over displacement of both bodies: up to 2.2 for ears and shakers in
# radians (rocking at resonance 5, base rocking 1), in degrees 57 times as much of 0.15 or more.
_DEGREES = 6.0
_LOWEST_TOP_HZ = 40.0  # a band that ends below is not of hearing


@dataclass(frozen=True)
class Reading:
    """Another meaning of the same file."""

    code: str
    meaning: str
    step: str
    read: Callable[[Data], Data]
    mild: bool = False  # tried in a small misfit too: an ear that hardly rocks hardly shows it
    most: float = np.inf  # chi2 per degree of freedom above which it is not reported
    of_columns: bool = False  # it changes some columns against others: without rotations nothing shows that


def _mapped(data: Data, matrix: Array) -> Data:
    """Return the motion times a matrix (2 m, 2 m), SI."""
    size = np.tile(data.root_mass, 2)
    scaled = matrix * np.outer(size, 1.0 / size)
    return replace(data, y=data.y @ scaled.T, covariance=scaled @ data.covariance @ scaled.T)


def _columns(matrix: Array) -> Callable[[Data], Data]:
    """Read the motion of both bodies through a matrix (6, 6)."""

    def read(data: Data) -> Data:
        own = matrix[np.ix_(*[dof_indices(data.measured)] * 2)]
        return _mapped(data, block_diag(own, own))

    return read


def _rotations(size: float) -> Callable[[Data], Data]:
    """Multiply rotations; the size of the whole motion is of no matter."""
    return _columns(np.diag([1.0, 1.0, 1.0, size, size, size]))


def _turning(data: Data) -> NDArray[np.bool_]:
    return np.array([name in DOF_NAMES[3:] for name in data.measured])


_SI = "Write metres and radians, and M in SI units"
_FRAME = "Correct the columns, or M: with a frame of the other hand they look alike"
_READINGS = (
    *(
        Reading(
            "unit_slip", f"{what}: in SI units the motion fits", _SI, _rotations(size), mild, _UNITS, True
        )
        for what, size, mild in (
            ("Rotations look like degrees", float(np.radians(1.0)), True),
            ("Rotations look like milliradians", 1e-3, False),
            ("Displacements look like millimetres", 1e3, False),
        )
    ),
    Reading(
        "phase_convention",
        "The phases look like those of amplitudes of e^{-iwt}: the conjugate motion fits",
        "Conjugate the motion, or state the convention to points2dof",
        lambda data: replace(data, y=data.y.conj(), covariance=data.covariance.conj()),
    ),
    Reading(
        "phase_convention",
        "Structure and base look read in opposite senses: the motion fits with one of them reversed",
        "Reverse the sign of all readings of the body whose directions point the wrong way",
        lambda data: _mapped(data, np.diag(np.repeat([1.0, -1.0], len(data.measured)))),
    ),
    Reading(
        "bodies_exchanged", "Structure and base look exchanged: the motion fits with their names swapped",
        "Exchange the names of the bodies, or --structure and --base",
        lambda data: _mapped(data, np.roll(np.eye(2 * len(data.measured)), len(data.measured), axis=0)),
    ),
    *(
        Reading(
            "phase_convention", f"{what}: so read the motion fits", _FRAME, _columns(read), False, _SURE, True
        )
        for what, read in (
            ("All rotations look of the other sign", np.diag([1, 1, 1, -1, -1, -1])),
            ("alpha and gamma look exchanged", np.eye(6)[[0, 1, 2, 5, 4, 3]]),
            *(
                (f"{DOF_NAMES[place]} looks of the other sign", np.eye(6) - 2.0 * np.diag(np.eye(6)[place]))
                for place in (0, 2, 3, 5)  # y turned is all others turned; beta hardly enters
            ),
        )
    ),
)  # fmt: skip


def suspicions(data: Data, options: KDOptions) -> list[Notice]:
    """Return a warning about a motion in other units, or one that fits only when it is read otherwise."""
    top = float(data.freq_hz.max())
    if "stapes" in options.structure.lower() and top < _LOWEST_TOP_HZ:
        text = f"The highest frequency is {top:.4g} Hz: freq_hz looks like kHz. Write Hz, 1000 times as much."
        return [Notice("unit_slip", text)]
    law = "viscous" if options.damping == COMPARE else options.damping
    model = Model(law, LOAD if data.loads_known else PLAIN)
    bare, mixed = data.without_errors(), 0 < np.sum(_turning(data)) < len(data.measured)
    own, n_dof = _level(bare, model), degrees(Likelihood(bare, model))
    misfit = chdtrc(n_dof, n_dof * own) < MISFIT_P
    tried = [
        (_level(reading.read(bare), model), number, reading)
        for number, reading in enumerate(_READINGS)
        if (own >= _BAD or (reading.mild and misfit)) and (mixed or not reading.of_columns)
    ]
    for level, _, reading in sorted(tried)[:1]:
        sure = misfit and chdtrc(n_dof, n_dof * level) > MISFIT_P and n_dof * (own - level) > _DECISIVE
        if sure or (own >= _BAD and level < min(_BETTER * own, reading.most)):
            text = f"{reading.meaning} with chi2 per degree of freedom {level:.3g} instead of {own:.3g}"
            return [Notice(reading.code, f"{text}. {reading.step}.")]
    return _degrees_by_size(data) if mixed else []


def _level(data: Data, model: Model) -> float:
    """Return chi2 per degree of freedom of a quick fit; infinite where there is none."""
    likelihood = Likelihood(data, model)
    try:
        _, chi2, _, _ = minimise(likelihood, best_start(likelihood), 1e-3, 20)
    except np.linalg.LinAlgError:
        return float("inf")
    return chi2 / max(degrees(likelihood), 1)


def _degrees_by_size(data: Data) -> list[Notice]:
    size = (np.sqrt(np.mean(np.abs(data.y) ** 2, axis=0)) / np.tile(data.root_mass, 2)).reshape(2, -1)
    turning = _turning(data)
    moved = np.maximum(np.linalg.norm(size[:, ~turning], axis=1), 1e-300)
    first, second = 1e-3 * np.linalg.norm(size[:, turning], axis=1) / moved
    if np.sqrt(first * second) < _DEGREES:
        return []
    text = (
        f"Rotations times 1 mm are {first:.3g} (structure) and {second:.3g} (base) times the "
        "displacements: they look like degrees. Write them in radians."
    )
    return [Notice("unit_slip", text)]
