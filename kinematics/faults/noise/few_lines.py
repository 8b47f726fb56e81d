"""The noise level of a body with few lines, estimated jointly with the errors of its positions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stapeskit.spatial import dof_indices

if TYPE_CHECKING:
    from kinematics.faults.fault_model import State
    from kinematics.faults.refit import Places

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
# Decades below the mean residual energy in which the level is sought, and steps of the search in each.
_DECADES, _STEPS = 8, 64
# Share of the largest information below which a shift leaves no trace in the residuals.
_UNSEEN = 1e-10


def shift_information(
    state: State, groups: list[list[int]], e: ComplexArray | None = None
) -> tuple[Array, Array]:
    """Return score (3 point,) and information (3 point, 3 point) of shifts of points.

    Parameters
    ----------
    state : State
    groups : list of list of int
        The channels of each point.
    e : ndarray, (channel, line), complex, optional
        Whitened residuals, those of ``state`` by default.
    """
    data = state.data
    e = state.e if e is None else e
    turned = np.cross(np.eye(3)[None], data.directions[:, None])
    change = np.concatenate([np.zeros_like(turned), turned], axis=2)
    rows = change[..., dof_indices(data.beams.dof)] @ data.beams.to_dof
    own = data.a[:, None, None] * (rows @ state.z)
    columns = np.zeros((len(groups), 3, *e.shape), dtype=complex)
    for number, channels in enumerate(groups):
        columns[number][:, channels] = own[channels].swapaxes(0, 1)
    flat = columns.reshape(3 * len(groups), *e.shape)
    if data.mixing is not None:
        flat = data.mixing.whiten @ flat
    flat = (flat - state.span @ (state.span.T @ flat)).reshape(3 * len(groups), -1)
    return np.real(flat.conj() @ e.ravel()), np.real(flat.conj() @ flat.T)


def level_of_all(state: State, rest: ComplexArray, places: Places) -> tuple[float, float]:
    """Return the variance of the complex whitened noise, and the degrees of freedom that it rests on.

    Parameters
    ----------
    state : State
        With the points where the file says.
    rest : ndarray, (channel, sample), complex
        Whitened residuals of the lines without motion.
    places : Places
        Points whose position has a stated error.

    Notes
    -----
    Restricted maximum likelihood of a variance next to random effects (Patterson and Thompson 1971,
    doi:10.1093/biomet/58.3.545): along the eigenvectors of the information of the shifts, in units of their
    sd, the real residuals have the variance v / 2 + lambda_i, along all other directions v / 2.
    """
    energy = float(np.sum(np.abs(state.e) ** 2) + np.sum(np.abs(rest) ** 2))
    free = len(state.data.live) - state.span.shape[1]
    number = 2.0 * free * (state.e.shape[1] + rest.shape[1])
    if not number > 0.0 or not energy > 0.0:
        return 0.0, 1.0
    plain = 2.0 * energy / number
    if not places.owners:
        return plain, number
    score, information = shift_information(state, places.owners)
    sd = np.repeat(places.sd_m, 3)
    values, vectors = np.linalg.eigh(information * np.outer(sd, sd))
    seen = values > _UNSEEN * max(float(values[-1]), 1e-300)
    values, along = values[seen], (vectors.T @ (sd * score))[seen] ** 2 / values[seen]
    others = max(number - len(values), 1.0)
    left = max(energy - float(np.sum(along)), 1e-12 * energy)
    half = 0.5 * plain * np.geomspace(10.0**-_DECADES, 1.0, _DECADES * _STEPS + 1)[:, None]
    size = half + values
    minus = np.sum(np.log(size) + along / size, axis=1) + (others * np.log(half) + left / half)[:, 0]
    best = float(half[int(np.argmin(minus)), 0])
    sure = others + float(np.sum((best / (best + values)) ** 2))
    return 2.0 * best, sure
