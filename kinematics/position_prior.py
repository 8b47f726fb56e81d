"""Allow for position errors of the size that was stated, before anything is called a fault."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kinematics.fault_model import LineData, solve
from kinematics.spatial import dof_indices

Array = NDArray[np.float64]
_ROUNDS = 2


def settled(data: LineData, sd_m: Array) -> tuple[LineData, float]:
    """Move all points to their most probable positions, jointly.

    Parameters
    ----------
    data : LineData
    sd_m : ndarray, (channel,)
        Prior standard deviation per coordinate, m; zero where a position is taken as exact.

    Returns
    -------
    LineData
        With moved points and the rows that belong to them.
    float
        Half the sum of (shift / sd)^2.
    """
    if not np.any(sd_m > 0.0):
        return data, 0.0
    names = [name for name in dict.fromkeys(data.points) if sd_m[data.points.index(name)] > 0.0]
    owners = [[c for c, point in enumerate(data.points) if point == name] for name in names]
    prior = np.repeat([sd_m[channels[0]] for channels in owners], 3)
    shift = np.zeros(3 * len(names))
    moved = data
    for _ in range(_ROUNDS):
        shift = shift + _step(moved, owners, shift, prior)
        arms = data.arms_m.copy()
        for place, channels in enumerate(owners):
            arms[channels] += shift[3 * place : 3 * place + 3]
        basis = data.row(arms, data.directions)
        moved = replace(data, arms_m=arms, beams=replace(data.beams, basis=basis))
    return moved, 0.5 * float(np.sum((shift / prior) ** 2))


def _step(data: LineData, owners: list[list[int]], shift: Array, prior: Array) -> Array:
    """Return one Gauss-Newton step of all shifts, with the motion projected out."""
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
    return np.asarray(np.linalg.solve(information / np.outer(scale, scale), score / scale) / scale)
