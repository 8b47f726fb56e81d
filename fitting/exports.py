"""The files of a fit: kd.json, kd.html, kd.mat, kd.csv always; on request for finite elements and as a prior.

An export is one entry of `EXPORTS`: names of its files behind the stem, and a function of the fit.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting import entries
from fitting.ring import ring_of
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.report.quantities import si_unit
from stapeskit.spatial import dof_indices

if TYPE_CHECKING:
    from fitting.result import KDFit


def entry_columns(fit: KDFit) -> dict[str, Sequence[Any]]:
    """Return one row an entry of K and D: value, sd, limits and unit in columns of their own, SI."""
    rows, columns = entries.upper(len(fit.dof))
    pairs = [(fit.dof[row], fit.dof[column]) for row, column in zip(rows, columns, strict=True)]
    return {
        "entry": fit.parameters,
        "row": [row for row, _ in pairs] * 2,
        "column": [column for _, column in pairs] * 2,
        "value": fit.values.tolist(),
        "sd": fit.sd.tolist(),
        "noise_only_sd": fit.noise_sd.tolist(),
        "lower_95": fit.intervals[:, 0].tolist(),
        "upper_95": fit.intervals[:, 1].tolist(),
        "unit": [si_unit(letter, *pair, fit.law.time_power) for letter in "KD" for pair in pairs],
    }


def csv_of(columns: Mapping[str, Sequence[Any]]) -> str:
    """Return columns as comma-separated text; pandas would take a tenth of the command to load."""
    rows = zip(*columns.values(), strict=True)
    return "".join(",".join(map(str, row)) + "\n" for row in (columns, *rows))


def matlab(fit: KDFit) -> bytes:
    """Return K, D and M with standard deviations and joint covariance as a MATLAB file (level 5)."""
    from scipy.io import savemat

    stream = io.BytesIO()
    stiffness_sd, damping_sd = fit.standard_deviation
    content = {
        "K": fit.stiffness,
        "K_sd": stiffness_sd,
        "D": fit.damping,
        "D_sd": damping_sd,
        "M": fit.mass,
        "dof": np.array(fit.dof, dtype=object),
        "damping_law": fit.law.name,
        "damping_exponent": fit.law.time_power,
        "parameters": np.array(fit.parameters, dtype=object),
        "values": fit.values[:, None],
        "covariance": fit.covariance,
        "readme": "SI; about the footplate centre in footplate axes; Z(w) = K + s(w) D, e^(+iwt)",
    }
    savemat(stream, content, oned_as="column")
    return stream.getvalue()


_HEAD = (
    "K, D, M of the suspension and the body, SI (m, kg, s, N, rad); footplate axes: y lateral, x anterior.",
    "Node 1: the body at the footplate centre; node 2: its surroundings (base) at the same place.",
    "K and D act on the difference of both nodes; M on node 1. Degrees of freedom: UX UY UZ ROTX ROTY ROTZ.",
)


def _two_nodes(fit: KDFit) -> Iterator[tuple[str, Array]]:
    """Yield K, D and M as matrices (12, 12) of two nodes with six degrees of freedom, zero in others.

    Raises
    ------
    StapeskitError
        The damping law has no matrix that finite elements take.
    """
    if fit.law.name not in ("viscous", "hysteretic"):
        wanted = "asked for with viscous or hysteretic damping"
        step = "Fit with --damping viscous or hysteretic, or use the export prior"
        raise StapeskitError.of("--export fe", wanted, fit.law.name, "", step)
    places, inertia = dof_indices(fit.dof), fit.inertia
    between, on_first = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.diag([1.0, 0.0])
    for letter, part, nodes in (
        ("K", fit.stiffness, between),
        ("D", fit.damping, between),
        ("M", fit.mass, on_first),
    ):
        own = np.zeros((6, 6))
        own[np.ix_(places, places)] = part
        yield letter, np.kron(nodes, inertia.matrix if letter == "M" and inertia.complete else own)


def ansys(fit: KDFit) -> str:
    """Return MATRIX27 elements with real constants (Ansys Element Reference, MATRIX27, KEYOPT(2) = 0)."""
    lines = [*(f"! {line}" for line in _HEAD), "/PREP7", "N,1,0,0,0", "N,2,0,0,0"]
    options = {"K": 4, "D": 5, "M": 2}
    for number, (letter, full) in enumerate(_two_nodes(fit), 1):
        if letter == "D" and fit.law.name == "hysteretic":
            lines.append("! D is structural: imaginary part of the stiffness (hysteretic); enter it as such")
        lines += [f"ET,{number},MATRIX27", f"KEYOPT,{number},3,{options[letter]}"]
        first, *more = _in_rows(full[np.triu_indices(12)], 6)  # row by row of the upper triangle
        lines += [f"R,{number},{first}", *(f"RMORE,{words}" for words in more)]
        lines += [f"TYPE,{number}", f"REAL,{number}", "E,1,2"]
    return "\n".join(lines) + "\n"


def abaqus(fit: KDFit) -> str:
    """Return a *USER ELEMENT, LINEAR with stiffness, damping and mass matrices (Abaqus Keywords Guide)."""
    damping = "VISCOUS DAMPING" if fit.law.name == "viscous" else "STRUCTURAL DAMPING"
    names = {"K": "STIFFNESS", "D": damping, "M": "MASS"}
    lines = [*(f"** {line}" for line in _HEAD), "*NODE", "1, 0., 0., 0.", "2, 0., 0., 0."]
    lines += ["*USER ELEMENT, LINEAR, NODES=2, TYPE=U1", "1, 2, 3, 4, 5, 6"]
    for letter, full in _two_nodes(fit):
        lines.append(f"*MATRIX, TYPE={names[letter]}")
        for row in range(12):  # lower triangle by rows, four numbers a line
            lines += _in_rows(full[row, : row + 1], 4)
    lines += ["*ELEMENT, TYPE=U1, ELSET=SUSPENSION", "1, 1, 2", "*UEL PROPERTY, ELSET=SUSPENSION"]
    return "\n".join(lines) + "\n"


def _in_rows(values: Array, count: int) -> list[str]:
    """Return numbers as lines of so many, with commas between them."""
    words = [f"{value:.9e}" for value in values]
    return [",".join(words[first : first + count]) for first in range(0, len(words), count)]


def comsol(fit: KDFit) -> str:
    """Return a parameter file of COMSOL: name, value with unit, comment."""
    lines = []
    for letter, part in (("K", fit.stiffness), ("D", fit.damping), ("M", fit.mass)):
        for row, column in zip(*entries.upper(len(fit.dof)), strict=True):
            first, second = fit.dof[row], fit.dof[column]
            unit = si_unit(letter, first, second, fit.law.time_power).replace(" ", "*")
            if letter == "M":
                unit = ("kg", "kg*m", "kg*m^2")[(first not in "xyz") + (second not in "xyz")]
            value = f"{part[row, column]:.12e}[{unit}]"
            lines.append(f'{letter}{row + 1}{column + 1} {value} "{first}, {second}"')
    return "\n".join(lines) + "\n"


def prior_json(fit: KDFit) -> str:
    """Return K and D as a joint normal distribution, a prior for updating a finite element model."""
    ring = ring_of(fit)
    content: dict[str, Any] = {
        "schema": "stapeskit.prior/1",
        "about": "footplate_centre",
        "axes": "footplate",
        "dof": list(fit.dof),
        "distribution": "normal",
        "damping_law": fit.law.formula,
        "parameters": list(fit.parameters),
        "units": list(entry_columns(fit)["unit"]),
        "mean_si": fit.values.tolist(),
        "covariance_si": fit.covariance.tolist(),
        "ring": None
        if ring is None
        else {
            "shear_modulus_times_thickness_over_width_pa": ring.shear_pa[0],
            "sd_pa": ring.shear_pa[1],
            "loss_factor": ring.loss_factor[0],
            "loss_factor_sd": ring.loss_factor[1],
        },
    }
    return json.dumps(content, indent=1) + "\n"


def prior_csv(fit: KDFit) -> str:
    """Return mean, unit and joint covariance, a row a parameter."""
    columns = entry_columns(fit)
    table = {"entry": columns["entry"], "mean": columns["value"], "unit": columns["unit"]}
    for name, column in zip(fit.parameters, fit.covariance.T.tolist(), strict=True):
        table[f"cov_{name}"] = column
    return csv_of(table)


EXPORTS: dict[str, dict[str, Callable[[KDFit], str]]] = {
    "fe": {"_ansys.inp": ansys, "_abaqus.inp": abaqus, "_comsol.txt": comsol},
    "prior": {"_prior.json": prior_json, "_prior.csv": prior_csv},
}
"""Files of each export behind the stem of kd.json, and what makes them."""


def file_names(name: str, export: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of all files of a fit.

    Raises
    ------
    StapeskitError
        There is no such export, or the name does not end with .json.
    """
    wrong = [one for one in export if one not in EXPORTS]
    if wrong:
        raise StapeskitError.of("--export", f"names out of {', '.join(EXPORTS)}", ", ".join(wrong))
    if Path(name).suffix.lower() != ".json":
        raise StapeskitError.of("--out", "a file name that ends with .json", name)
    stem = Path(name).stem
    more = (f"{stem}{ending}" for one in export for ending in EXPORTS[one])
    return (name, *(f"{stem}{ending}" for ending in (".html", ".mat", ".csv")), *more)
