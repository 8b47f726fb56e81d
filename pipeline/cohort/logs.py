"""Logarithms of the quantities in laws, for every ear, with independent errors and errors that ears share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.cohort.covariates import Covariates, no_covariates
from pipeline.cohort.ears import SHARED_SOURCES, Ear, common_damping_exponent, source_id
from pipeline.cohort.law import LogPairs
from stapeskit.arrays import Array
from stapeskit.spatial import central_tensor
from stapeskit.warnings import Notice, unique

# How a relative error of the voxel size enters: masses and forces go with its third power, moments of
# inertia and rotational stiffnesses with its fifth, lengths and areas with their own.
_VOXEL_POWERS = {
    "mass_kg": 3.0,
    **{f"J{k}_kg_m2": 5.0 for k in (1, 2, 3)},
    "footplate_area_m2": 2.0,
    "footplate_length_m": 1.0,
    "footplate_width_m": 1.0,
    "height_m": 1.0,
    "gap_m": 1.0,
}
PREDICTORS = tuple(_VOXEL_POWERS)
_LENGTHS = {
    "footplate_area_m2": ("footplate_area_mm2", 1e-6),
    "footplate_length_m": ("footplate_length_mm", 1e-3),
    "footplate_width_m": ("footplate_width_mm", 1e-3),
    "height_m": ("height_mm", 1e-3),
    "gap_m": ("gap_mm", 1e-3),
}
# Standard deviation, in voxels, of lengths whose mass.json states none: both ends are rounded to a voxel,
# each with a variance of 1/12. Lengths of surfaces within voxels are better than that.
_LENGTH_SD_VOXELS = (2.0 / 12.0) ** 0.5


@dataclass(frozen=True)
class LogTable:
    """Logarithms of all quantities of all ears.

    Attributes
    ----------
    values : ndarray, (n, p)
        Natural logarithms in SI, predictors first; NaN where an ear lacks one or it is not positive.
    own : ndarray, (n, p, p)
        Covariance of the errors of each ear alone.
    shared : ndarray, (n, p, s)
        Effect of each error that ears share, in its standard deviations.
    sources : tuple of str
        Names of the shared errors.
    subject : ndarray of int, (n,)
    ears : tuple of str
        Folders of the ears, one a row.
    """

    predictors: tuple[str, ...]
    responses: tuple[str, ...]
    values: Array
    own: Array
    shared: Array
    sources: tuple[str, ...]
    subject: NDArray[np.int64]
    notices: tuple[Notice, ...]
    covariates: Covariates
    ears: tuple[str, ...]

    @property
    def entries(self) -> list[str]:
        """The responses that are entries of K and D."""
        return [name for name in self.responses if "principal" not in name]

    def column(self, name: str) -> int:
        """Return the column of a quantity.

        Raises
        ------
        KeyError
            There is none of that name.
        """
        return (*self.predictors, *self.responses).index(self.full_name(name))

    def full_name(self, name: str) -> str:
        """Return the whole name of a quantity: ``mass`` for ``mass_kg``.

        Raises
        ------
        KeyError
            There is none, or more than one, of that name.
        """
        names = (*self.predictors, *self.responses)
        close = [known for known in names if known == name] or [
            known for known in names if known.startswith(f"{name}_")
        ]
        if len(close) != 1:
            raise KeyError(name)
        return close[0]

    def pairs(self, response: str, predictor: str) -> tuple[LogPairs, NDArray[np.bool_]]:
        """Return predictor and response of the ears that have both, and which ears these are, (n,)."""
        columns = [self.column(predictor), self.column(response)]
        keep = np.all(np.isfinite(self.values[:, columns]), axis=1)
        chosen = np.ix_(keep, columns)
        return (
            LogPairs(
                self.values[chosen][:, 0],
                self.values[chosen][:, 1],
                self.own[keep][:, columns][:, :, columns],
                self.shared[keep][:, columns],
                self.subject[keep],
                self.covariates.columns[keep],
            ),
            keep,
        )


def log_table(ears: Sequence[Ear], covariates: Covariates | None = None) -> LogTable:
    """Take the logarithms of the predictors and responses of all ears and split their errors.

    Parameters
    ----------
    ears : sequence of Ear
        Of the same degrees of freedom.
    covariates : Covariates, optional
    """
    dof = list(ears[0].kd["dof"])
    letters = "K" if common_damping_exponent(ears) is None else "KD"
    responses = tuple(f"{letter}{k}{k}" for letter in letters for k in range(1, len(dof) + 1))
    if all((ear.kd.get("principal_axes") or {}).get("stiffness_si") for ear in ears):
        responses += ("K_principal_2", "K_principal_3")
    rows = [_ear_logs(ear, responses) for ear in ears]
    notices = [notice for row in rows for notice in row.notices]
    if letters == "K":
        text = (
            "D has no common unit: the power of time differs between the damping laws. No law of D is fitted."
        )
        notices.append(Notice("damping_not_comparable", text))
    sources = tuple(sorted({source for row in rows for source in row.shared}))
    p = len(PREDICTORS) + len(responses)
    shared = np.zeros((len(ears), p, len(sources)))
    for place, row in enumerate(rows):
        for source, effect in row.shared.items():
            shared[place, :, sources.index(source)] = effect
    persons = [str(ear.about.get("subject") or f"{place} {ear.name}") for place, ear in enumerate(ears)]
    known = list(dict.fromkeys(persons))
    values = np.array([row.values for row in rows])
    present = np.any(np.isfinite(values), axis=0)
    names = [name for name, has in zip((*PREDICTORS, *responses), present, strict=True) if has]
    keep = np.flatnonzero(present)
    return LogTable(
        tuple(name for name in names if name in PREDICTORS),
        tuple(name for name in names if name not in PREDICTORS),
        values[:, keep],
        np.array([row.own for row in rows])[:, keep][:, :, keep],
        shared[:, keep],
        sources,
        np.array([known.index(person) for person in persons]),
        unique(notices),
        no_covariates(len(ears)) if covariates is None else covariates,
        tuple(ear.folder for ear in ears),
    )


@dataclass(frozen=True)
class _EarLogs:
    values: Array
    own: Array
    shared: Mapping[str, Array]
    notices: tuple[Notice, ...]


def _ear_logs(ear: Ear, responses: tuple[str, ...]) -> _EarLogs:
    """Return the logarithms of one ear, their own covariance and the effect of each error that ears share."""
    inertia, parts = _inertia_logs(ear.mass)
    lengths, length_cov, notices = _length_logs(ear.mass)
    kd_values, kd_cov, kd_parts = _response_logs(ear.kd, responses)
    a, b = len(inertia), len(inertia) + len(lengths)
    values = np.concatenate([inertia, lengths, kd_values])
    own = np.zeros((len(values), len(values)))
    own[a:b, a:b] = length_cov
    own[b:, b:] = kd_cov
    shared: dict[str, Array] = {}
    for source, covariance in parts.items():
        relative = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        response = kd_parts.get(f"mass.{source}", np.zeros(len(kd_values)))
        if source in SHARED_SOURCES:
            effect = np.concatenate([relative, np.zeros(len(lengths)), response])
            if source == "voxel_size":
                scale = relative[0] / _VOXEL_POWERS["mass_kg"] if relative[0] else relative[1] / 2.0
                powers = [_VOXEL_POWERS[name] for name in PREDICTORS[a:b]]
                effect[a:b] = scale * np.array(powers)
            own[b:, b:] -= np.outer(response, response)
            shared[source_id(ear, source)] = shared.get(source_id(ear, source), 0.0) + effect
            continue
        own[:a, :a] += covariance
        # Noise and grey levels of the scan scale the whole body: K follows the error of the mass.
        own[:a, b:] += np.outer(relative, response)
        own[b:, :a] += np.outer(response, relative)
    return _EarLogs(values, _positive(own), shared, notices)


def _inertia_logs(mass: Mapping[str, Any]) -> tuple[Array, dict[str, Array]]:
    """Return ln of mass and principal inertias, and their covariance by contribution."""
    record = mass["inertial_parameters"]
    theta = np.asarray(record["values_si"], dtype=float)
    jacobian = _derivative(_logs_of_parameters, theta)
    parts = record.get("contributions_si") or {"all": record["covariance_si"]}
    return _logs_of_parameters(theta), {
        name: jacobian @ np.asarray(covariance, dtype=float) @ jacobian.T
        for name, covariance in parts.items()
    }


def _logs_of_parameters(theta: Array) -> Array:
    """Return ln of the mass and of the principal moments about the centre of mass, ascending."""
    mass, tensor = central_tensor(theta)
    return np.log(np.r_[mass, np.linalg.eigvalsh(tensor)])


def _derivative(function: Callable[[Array], Array], at: Array) -> Array:
    """Return the derivative (outputs, inputs) by central differences of a millionth of each input."""
    sizes = 1e-6 * np.maximum(np.abs(at), 1e-6 * np.abs(at[np.r_[0, 0, 0, 0, 4, 4, 4, 4, 4, 4]]))
    steps = np.diag(sizes)
    return np.array(
        [(function(at + h) - function(at - h)) / (2.0 * s) for h, s in zip(steps, sizes, strict=True)]
    ).T


def _length_logs(mass: Mapping[str, Any]) -> tuple[Array, Array, tuple[Notice, ...]]:
    """Return ln of the lengths that the scan shows, and their covariance."""
    lengths = mass.get("found") or {}
    voxels = (mass.get("segmentation") or {}).get("voxel_size_mm")
    values, variances = [], []
    length_sd_mm = 0.0 if voxels is None else _LENGTH_SD_VOXELS * float(np.mean(voxels))
    for name, (key, factor) in _LENGTHS.items():
        value = lengths.get(key)
        values.append(np.log(float(value) * factor) if value is not None and float(value) > 0.0 else np.nan)
        size = float(np.sqrt(value)) if name.endswith("area_m2") and value else float(value or np.inf)
        stated = lengths.get(f"{key.removesuffix('_mm')}_sd_mm")
        sd_mm = length_sd_mm if stated is None else float(stated)
        variances.append((sd_mm / size * _VOXEL_POWERS[name]) ** 2)
    assumed = (
        "that of two ends rounded to voxels was taken"
        if voxels is not None
        else "those of meshes count as exact"
    )
    text = f"Lengths of the footplate have no stated standard deviation: {assumed}."
    return np.array(values), np.diag(variances), (Notice("predictor_error_assumed", text),)


def _response_logs(
    kd: Mapping[str, Any], responses: tuple[str, ...]
) -> tuple[Array, Array, dict[str, Array]]:
    """Return ln of K and D, their covariance from all sources, and relative effects by contribution."""
    parameters = list(kd["parameters"])
    covariance = np.asarray(kd["covariance_si"], dtype=float)
    matrices = {
        "K": np.asarray(kd["stiffness_si"], dtype=float),
        "D": np.asarray(kd["damping_si"], dtype=float),
    }
    gradients, sizes = [], []
    for name in responses:
        gradient = np.zeros(len(parameters))
        if name.startswith("K_principal"):
            size, gradient = _principal(matrices["K"], parameters, int(name[-1]))
        else:
            size = matrices[name[0]][int(name[1]) - 1, int(name[2]) - 1]
            if name in parameters:
                gradient[parameters.index(name)] = 1.0
        sizes.append(size)
        gradients.append(gradient)
    value = np.array(sizes)
    positive = value > 0.0
    logs = np.log(np.where(positive, value, np.nan))
    jacobian = np.array(gradients) / np.where(positive, value, 1.0)[:, None]
    # Errors of the mass scale K and D: they move each entry in proportion to it.
    sign = [np.sign(matrices[name[0]][int(name[1]) - 1, int(name[2]) - 1]) for name in parameters]
    parts = {
        source: jacobian @ (sign * np.array([float(entries.get(name) or 0.0) for name in parameters]))
        for source, entries in (kd.get("budget") or {}).items()
    }
    return logs, jacobian @ np.nan_to_num(covariance) @ jacobian.T, parts


def _principal(stiffness: Array, parameters: list[str], which: int) -> tuple[float, Array]:
    """Return a rotational principal stiffness of (y, alpha, gamma) and its derivative by the entries of K."""

    def value(entries: Array) -> float:
        k = np.zeros(stiffness.shape)
        k[rows, columns] = k[columns, rows] = entries
        reduced = k[1:, 1:] - np.outer(k[1:, 0], k[0, 1:]) / k[0, 0]
        return float(np.linalg.eigvalsh(reduced)[which - 2])

    rows, columns = np.triu_indices(len(stiffness))
    upper = stiffness[rows, columns]
    gradient = np.zeros(len(parameters))
    for k, entry in enumerate(upper):
        step = np.zeros(len(upper))
        step[k] = 1e-6 * max(abs(entry), 1e-12)
        gradient[k] = (value(upper + step) - value(upper - step)) / (2.0 * step[k])
    return value(upper), gradient


def _positive(matrix: Array) -> Array:
    """Return the nearest positive semidefinite matrix: differences of variances may fall below zero."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    roots, axes = np.linalg.eigh(matrix / np.outer(size, size))
    return np.asarray((axes * np.maximum(roots, 0.0)) @ axes.T * np.outer(size, size))
