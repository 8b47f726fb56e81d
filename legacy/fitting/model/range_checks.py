"""Refuse what cannot be fitted: lines far beyond all others, results that are not finite."""

from __future__ import annotations

import numpy as np

from legacy.fitting.errors import FittingError
from legacy.fitting.model.observation import Observation
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, raise_all

# Of one line to the median of all lines: a resonance reaches 1e3, a vibrometer's dynamic range is 1e6.
MOST = 1e7


def check_motion(observation: Observation) -> None:
    """Refuse lines at which a motion is larger than the median of all lines by more than any resonance.

    Degrees of freedom that hardly move are compared with the largest median of their kind.

    Raises
    ------
    FittingError
        Names body, degree of freedom, run and frequency of every such value.
    """
    names = [f"the structure's {name}" for name in (*observation.dof, *observation.load_dof)]
    names += [f"the base's {name}" for name in observation.dof]
    size = np.abs(observation.q)
    turns = np.array([name.split()[-1] not in ("x", "y", "z") for name in names])
    middle = np.median(size, axis=0)
    for kind in (turns, ~turns):
        if np.any(kind):
            middle[kind] = np.max(middle[kind])
    faults = []
    for line, column in np.argwhere(size > MOST * middle):
        if middle[column] == 0.0:
            continue
        unit = "rad" if turns[column] else "m"
        run = f", run {observation.runs[observation.run[line]]}" if len(observation.runs) > 1 else ""
        faults.append(
            Fault(
                names[column],
                f"of a size like at the other lines, {middle[column]:.3g} {unit} in the median",
                f"{size[line, column]:.3g} {unit}",
                f"{observation.freq_hz[line]:.6g} Hz{run}",
                "Correct this line, or leave it out by {exclude}",
            )
        )
    raise_all(FittingError, faults)


def check_result(*results: Array) -> None:
    """Refuse matrices and covariances that are not finite, or variances below zero.

    Raises
    ------
    FittingError
        Any of these.
    """
    good = all(bool(np.all(np.isfinite(result))) for result in results)
    if not (good and all(np.all(np.diag(matrix) >= 0.0) for matrix in results[2:])):
        raise unsolvable()


def unsolvable() -> FittingError:
    """Return the error on equations that have no finite solution."""
    return FittingError.of(
        "motion and mass",
        "of sizes from which stiffness and damping follow",
        "equations without a finite solution",
        "",
        "Look for columns in wrong units or in each other's place, and for lines far beyond the others",
    )
