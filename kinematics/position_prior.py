"""Allow for position errors of the size that was stated, before anything is called a fault."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from kinematics.fault_model import LineData, solve
from kinematics.spatial import dof_indices

Array = NDArray[np.float64]
_ROUNDS = 2


@dataclass(frozen=True)
class Settled:
    """Data with every point at its most probable position.

    Attributes
    ----------
    data : LineData
        With moved points and the rows that belong to them.
    penalty : float
        Half the sum of (shift / sd)^2.
    shifts_m : mapping of str to ndarray, (3,)
        By point; only points with a prior.
    covariances : mapping of str to ndarray, (3, 3)
        Posterior covariance of each shift, m2.
    evidence : mapping of str to float
        How far each shift is beyond its prior: chi-squared with up to 3 degrees of freedom when the stated
        sd is right.
    """

    data: LineData
    penalty: float = 0.0
    shifts_m: Mapping[str, Array] = field(default_factory=dict)
    covariances: Mapping[str, Array] = field(default_factory=dict)
    evidence: Mapping[str, float] = field(default_factory=dict)

    def objective(self) -> float:
        """Return the residual energy with the penalty."""
        return float(np.sum(np.abs(solve(self.data).e) ** 2)) + self.penalty


def settled(data: LineData, sd_m: Array) -> Settled:
    """Move all points to their most probable positions, jointly.

    Parameters
    ----------
    data : LineData
    sd_m : ndarray, (channel,)
        Prior standard deviation per coordinate, m; zero where a position is taken as exact.
    """
    if not np.any(sd_m > 0.0):
        return Settled(data)
    names = [name for name in dict.fromkeys(data.points) if sd_m[data.points.index(name)] > 0.0]
    owners = [[c for c, point in enumerate(data.points) if point == name] for name in names]
    prior = np.repeat([sd_m[channels[0]] for channels in owners], 3)
    shift = np.zeros(3 * len(names))
    moved, inverse = data, np.zeros((len(prior), len(prior)))
    for _ in range(_ROUNDS):
        step, inverse = _step(moved, owners, shift, prior)
        shift = shift + step
        arms = data.arms_m.copy()
        for place, channels in enumerate(owners):
            arms[channels] += shift[3 * place : 3 * place + 3]
        moved = data.moved(arms_m=arms)
    parts = [slice(3 * place, 3 * place + 3) for place in range(len(names))]
    return Settled(
        moved,
        0.5 * float(np.sum((shift / prior) ** 2)),
        {name: shift[part] for name, part in zip(names, parts, strict=True)},
        {name: 0.5 * inverse[part, part] for name, part in zip(names, parts, strict=True)},
        {
            name: _evidence(shift[part], 0.5 * inverse[part, part], float(prior[part.start]))
            for name, part in zip(names, parts, strict=True)
        },
    )


def _evidence(shift: Array, covariance: Array, sd: float) -> float:
    """Return the size of a shift against what the prior lets the data show of it."""
    values, vectors = np.linalg.eigh(np.eye(3) - covariance / sd**2)
    seen = values > 0.05
    along = vectors.T @ shift / sd
    return float(np.sum(along[seen] ** 2 / values[seen]))


def _step(data: LineData, owners: list[list[int]], shift: Array, prior: Array) -> tuple[Array, Array]:
    """Return one Gauss-Newton step of all shifts, the motion projected out, and the inverse information."""
    state = solve(data)
    places = dof_indices(data.beams.dof)
    size = len(prior)
    score = np.empty(size)
    diagonal = np.zeros((size, size))
    seen = np.empty((size, *state.z.shape), dtype=complex)
    for owner, channels in enumerate(owners):
        values = []
        for axis in range(3):
            change = np.zeros((len(channels), 6))
            change[:, 3:] = np.cross(np.eye(3)[axis], data.directions[channels])
            values.append(data.s[channels] * (change[:, places] @ data.beams.to_dof @ state.z.T))
        columns = np.stack(values)
        part = slice(3 * owner, 3 * owner + 3)
        score[part] = np.real(np.einsum("kcf,cf->k", columns.conj(), state.e[channels]))
        diagonal[part, part] = np.real(np.einsum("kcf,lcf->kl", columns.conj(), columns))
        seen[part] = np.einsum("kcf,cm->kfm", columns * data.s[channels], data.beams.basis[channels])
    half = np.linalg.cholesky(state.inverse + 0j)
    projected = np.einsum("kfm,fmn->kfn", seen.conj(), half).reshape(size, -1)
    information = diagonal - np.real(projected @ projected.conj().T)
    information += np.diag(0.5 / prior**2)
    score -= 0.5 * shift / prior**2
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return inverse @ score, inverse
