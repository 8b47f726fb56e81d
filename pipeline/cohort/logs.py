"""Logarithms of the quantities in laws, for every ear, with independent errors and errors that ears share."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.cohort.ears import SHARED_SOURCES, Ear, common_damping_exponent, source_id
from pipeline.cohort.law import LogPairs
from stapeskit.arrays import Array
from stapeskit.spatial import central_tensor
from stapeskit.warnings import Notice

_INERTIA = ("mass_kg", "J1_kg_m2", "J2_kg_m2", "J3_kg_m2")
_LENGTHS = {
    "footplate_area_m2": ("footplate_area_mm2", 2),
    "footplate_length_m": ("footplate_length_mm", 1),
    "footplate_width_m": ("footplate_width_mm", 1),
    "height_m": ("height_mm", 1),
    "gap_m": ("gap_mm", 1),
}
"""What a scan shows: key in mass.json, and its power of a length."""
PREDICTORS = (*_INERTIA, *_LENGTHS)
# A relative error of the voxel size enters masses and forces with its third power.
_VOXEL_POWER_OF_MASS = 3.0
# Standard deviation, in voxels, of lengths whose mass.json states none: both ends are rounded to a voxel,
# each with a variance of 1/12. Lengths of surfaces within voxels are better than that.
_LENGTH_SD_VOXELS = (2.0 / 12.0) ** 0.5


def responses_of(dof: int, letters: str = "KD", principal: bool = True) -> tuple[str, ...]:
    """Return the responses of ears of so many degrees of freedom: diagonals, and principal stiffnesses."""
    own = tuple(f"{letter}{k}{k}" for letter in letters for k in range(1, dof + 1))
    return (*own, "K_principal_2", "K_principal_3") if principal else own


def full_name(name: str, names: Collection[str]) -> str:
    """Return the whole name of a quantity: ``mass_kg`` for ``mass``.

    Raises
    ------
    KeyError
        There is none, or more than one, of that name.
    """
    close = [known for known in names if known.startswith(f"{name}_")]
    if name not in names and len(close) != 1:
        raise KeyError(name)
    return name if name in names else close[0]


@dataclass(frozen=True)
class LogTable:
    """Logarithms of all quantities of all ears."""

    predictors: tuple[str, ...]
    responses: tuple[str, ...]
    # (n, p): natural logarithms in SI, predictors first; NaN where an ear lacks one or it is not positive
    values: Array
    own: Array  # (n, p, p): covariance of the errors of each ear alone
    shared: Array  # (n, p, s): effect of each error that ears share, in its standard deviations
    sources: tuple[str, ...]  # names of the shared errors
    subject: NDArray[np.int64]  # (n,)
    notices: tuple[Notice, ...]

    @property
    def entries(self) -> list[str]:
        """The responses that are entries of K and D."""
        return [name for name in self.responses if "principal" not in name]

    def column(self, name: str) -> int:
        """Return the column of a quantity."""
        return (*self.predictors, *self.responses).index(name)

    def columns(self, response: str, predictor: str) -> list[int]:
        """Return the columns of a predictor and a response."""
        return [self.column(predictor), self.column(response)]

    def pairs(self, response: str, predictor: str) -> LogPairs:
        """Return predictor and response of the ears that have both."""
        columns = self.columns(response, predictor)
        keep = np.all(np.isfinite(self.values[:, columns]), axis=1)
        x, y = self.values[keep][:, columns].T
        own, shared = self.own[keep][:, columns][:, :, columns], self.shared[keep][:, columns]
        return LogPairs(x, y, own, shared, self.subject[keep])


def log_table(ears: Sequence[Ear]) -> LogTable:
    """Take the logarithms of predictors and responses of ears of the same degrees of freedom."""
    n = len(ears[0].kd["dof"])
    letters = "K" if common_damping_exponent(ears) is None else "KD"
    principal = all((ear.kd.get("principal_axes") or {}).get("stiffness_si") for ear in ears)
    responses = responses_of(n, letters, principal)
    rows = [_ear_logs(ear, responses) for ear in ears]
    notices = list[Notice]()
    assumed = dict.fromkeys(row.lengths_assumed for row in rows if row.lengths_assumed)
    if assumed:
        text = f"Some lengths of the scans have no stated standard deviation: {'; '.join(assumed)}."
        notices.append(Notice("file_read", text))
    if letters == "K":
        text = "D has no common unit: its power of time differs between damping laws. No law of D is fitted."
        notices.append(Notice("laws_left_open", text))
    values = np.array([row.values for row in rows])
    keep = np.flatnonzero(np.any(np.isfinite(values), axis=0))
    names = [(*PREDICTORS, *responses)[place] for place in keep]
    sources = tuple(sorted({source for row in rows for source in row.shared}))
    none = np.zeros(values.shape[1])
    shared = np.array([[row.shared.get(source, none) for source in sources] for row in rows])
    persons = [str(ear.about.get("subject") or f"{place} {ear.name}") for place, ear in enumerate(ears)]
    return LogTable(
        tuple(name for name in names if name in PREDICTORS),
        tuple(name for name in names if name not in PREDICTORS),
        values[:, keep],
        np.array([row.own for row in rows])[:, keep][:, :, keep],
        shared.reshape(len(ears), len(sources), -1).swapaxes(1, 2)[:, keep],
        sources,
        np.unique(persons, return_inverse=True)[1],
        tuple(notices),
    )


@dataclass(frozen=True)
class _EarLogs:
    """Logarithms of one ear, their own covariance, the effect of each error that ears share, and in words
    the error that was assumed of lengths.
    """

    values: Array
    own: Array
    shared: Mapping[str, Array]
    lengths_assumed: str


def _ear_logs(ear: Ear, responses: tuple[str, ...]) -> _EarLogs:
    inertia, parts = _inertia_logs(ear.mass)
    lengths, length_variances, assumed = _length_logs(ear.mass)
    kd_values, kd_covariance, kd_parts = _response_logs(ear.kd, responses)
    a, b = len(inertia), len(inertia) + len(lengths)
    values = np.concatenate([inertia, lengths, kd_values])
    own = np.zeros((len(values), len(values)))
    own[a:b, a:b] = np.diag(length_variances)
    own[b:, b:] = kd_covariance
    shared: dict[str, Array] = {}
    for source, covariance in parts.items():
        relative = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        response = kd_parts.get(f"mass.{source}", np.zeros(len(kd_values)))
        if source in SHARED_SOURCES:
            effect = np.concatenate([relative, np.zeros(len(lengths)), response])
            if source == "voxel_size":
                powers = np.array([power for _, power in _LENGTHS.values()])
                # a mass that is known otherwise has no such error; moments of inertia have that of an area
                scale = relative[0] / _VOXEL_POWER_OF_MASS if relative[0] else relative[1] / 2.0
                effect[a:b] = scale * powers
            own[b:, b:] -= np.outer(response, response)
            name = source_id(ear, source)
            shared[name] = shared.get(name, 0.0) + effect
        else:
            own[:a, :a] += covariance
            # Noise and grey levels of the scan scale the whole body: K follows the error of the mass.
            own[:a, b:] += np.outer(relative, response)
            own[b:, :a] += np.outer(response, relative)
    return _EarLogs(values, _positive(own), shared, assumed)


def _inertia_logs(mass: Mapping[str, Any]) -> tuple[Array, dict[str, Array]]:
    """Return ln of mass and principal inertias, and their covariance by contribution."""
    record = mass["inertial_parameters"]
    theta = np.asarray(record["values_si"], dtype=float)

    def logs(theta: Array) -> Array:  # principal moments about the centre of mass, ascending
        mass_kg, tensor = central_tensor(theta)
        return np.log(np.r_[mass_kg, np.linalg.eigvalsh(tensor)])

    sizes = np.maximum(np.abs(theta), 1e-6 * np.abs(theta[[0, 0, 0, 0, 4, 4, 4, 4, 4, 4]]))
    jacobian = _derivative(logs, theta, sizes)
    parts = record.get("contributions_si") or {"all": record["covariance_si"]}
    return logs(theta), {
        name: jacobian @ np.asarray(covariance, dtype=float) @ jacobian.T
        for name, covariance in parts.items()
    }


def _derivative(function: Callable[[Array], Array], at: Array, sizes: Array) -> Array:
    """Return the derivative (outputs, inputs) by central differences of a millionth of the sizes."""
    steps = np.diag(1e-6 * sizes)
    return np.array([(function(at + h) - function(at - h)) / (2.0 * h.sum()) for h in steps]).T


def _length_logs(mass: Mapping[str, Any]) -> tuple[Array, Array, str]:
    """Return ln of the lengths that the scan shows, their variances, and what was assumed of these."""
    found = mass.get("found") or {}
    voxels = (mass.get("segmentation") or {}).get("voxel_size_mm")
    usual_mm = 0.0 if voxels is None else _LENGTH_SD_VOXELS * float(np.mean(voxels))
    values, variances, assumed = [], [], ""
    for key, power in _LENGTHS.values():
        value = float(found.get(key) or np.nan)
        value = value if value > 0.0 else np.nan
        stated = found.get(f"{key.removesuffix('_mm')}_sd_mm")
        if stated is None and value > 0.0:
            assumed = "those of meshes count as exact"
            if voxels is not None:
                assumed = "that of two ends rounded to voxels was taken"
        sd_mm = usual_mm if stated is None else float(stated)
        values.append(np.log(value * 1e-3**power))
        variances.append(np.nan_to_num((power * sd_mm / value ** (1.0 / power)) ** 2))
    return np.array(values), np.array(variances), assumed


def _response_logs(
    kd: Mapping[str, Any], responses: tuple[str, ...]
) -> tuple[Array, Array, dict[str, Array]]:
    """Return ln of K and D, their covariance from all sources, and relative effects by contribution."""
    parameters = list(kd["parameters"])
    matrices = {"K": np.asarray(kd["stiffness_si"]), "D": np.asarray(kd["damping_si"])}
    entries = np.array([matrices[name[0]][int(name[1]) - 1, int(name[2]) - 1] for name in parameters])
    n = len(matrices["K"])
    rows, columns = np.triu_indices(n)

    def values(entries: Array) -> Array:
        stiffness = np.zeros((n, n))
        stiffness[rows, columns] = stiffness[columns, rows] = entries[: len(rows)]
        reduced = stiffness[1:, 1:] - np.outer(stiffness[1:, 0], stiffness[0, 1:]) / stiffness[0, 0]
        principal = dict(zip(("K_principal_2", "K_principal_3"), np.linalg.eigvalsh(reduced), strict=False))
        return np.array([principal.get(name, entries[parameters.index(name)] if name in parameters else 0.0)
                         for name in responses])  # fmt: skip

    value = values(entries)
    positive = value > 0.0
    logs = np.log(np.where(positive, value, np.nan))
    sizes = np.where(entries == 0.0, np.abs(entries).min(initial=1.0, where=entries != 0.0), np.abs(entries))
    jacobian = _derivative(values, entries, sizes) / np.where(positive, value, 1.0)[:, None]
    # Errors of the mass scale K and D: they move each entry in proportion to it.
    parts = {
        source: jacobian @ (np.sign(entries) * [float(own.get(name) or 0.0) for name in parameters])
        for source, own in (kd.get("budget") or {}).items()
    }
    covariance = np.nan_to_num(np.asarray(kd["covariance_si"], dtype=float))
    return logs, jacobian @ covariance @ jacobian.T, parts


def _positive(matrix: Array) -> Array:
    """Return the nearest positive semidefinite matrix: differences of variances may fall below zero."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    roots, axes = np.linalg.eigh(matrix / np.outer(size, size))
    return np.asarray((axes * np.maximum(roots, 0.0)) @ axes.T * np.outer(size, size))
