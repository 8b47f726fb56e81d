"""The entries of K and D as a table."""

from __future__ import annotations

import numpy as np

from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.parameter_vector import entry_units, join, pairs


def content(fit: KDFit) -> bytes:
    """Return one row an entry: value, sd, 95 % interval and covariance with every other entry, SI."""
    units = entry_units(fit.dof)
    places = pairs(len(fit.dof))
    values, sd = join(fit.stiffness, fit.damping), np.sqrt(np.diag(fit.covariance))
    noise = np.sqrt(np.diag(fit.noise_covariance))
    head = ["entry", "row", "column", "unit", "value", "sd", "noise_only_sd", "low_95", "high_95"]
    rows = [[*head, *(f"cov_{name}" for name in fit.parameters)]]
    for at, name in enumerate(fit.parameters):
        row, column = places[at % len(places)]
        unit = units[row][column] if name[0] == "K" else fit.law.unit(units[row][column])
        numbers = [values[at], sd[at], noise[at], *fit.intervals[at], *fit.covariance[at]]
        rows.append([name, fit.dof[row], fit.dof[column], unit, *(repr(float(number)) for number in numbers)])
    return ("\n".join(",".join(row) for row in rows) + "\n").encode()
