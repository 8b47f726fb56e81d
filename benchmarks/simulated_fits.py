"""Fits of simulated ears beside the truth, and rows of a table, for the benchmarks of fitting."""

from __future__ import annotations

import numpy as np

from benchmarks.ring_ears import PISTON, SimulatedEar
from legacy.fitting.errors import FittingError
from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.parameter_vector import join
from legacy.fitting.options import KDOptions

BLOCK = np.ix_(PISTON, PISTON)
PLAIN = KDOptions(bands=0)
ALARMS = {"misfit", "cause_found", "fluid_found", "fluid_contradicts"}


def fitted(case: SimulatedEar, options: KDOptions = PLAIN) -> KDFit | None:
    """Return the fit of an ear, None where it is refused."""
    try:
        return fit_kd(case.motion, case.mass, options)
    except FittingError:
        return None


def truth(case: SimulatedEar) -> np.ndarray:
    """Return the entries of K and D of an ear."""
    return join(case.stiffness[BLOCK], case.damping[BLOCK])


def table(*heads: str) -> None:
    """Print the head of a table."""
    print("| " + " | ".join(heads) + " |\n|" + "-|" * len(heads), flush=True)


def row(*cells: str) -> None:
    """Print a row."""
    print("| " + " | ".join(cells) + " |", flush=True)
