"""Noise that the channels of a point have in common, as x, y, z solved from three oblique beams have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_SAME_BEAM = float(np.cos(np.radians(8.0)))
_LEAST_POINTS = 4
_LIKELY = 1e-4
_LEAST_CORRELATION = 0.05
_SINGULAR = 1e-3


@dataclass(frozen=True)
class Mixing:
    """The correlation of the noise of all channels, and what makes it white.

    Attributes
    ----------
    correlation : ndarray, (channel, channel)
        Unit diagonal; zero between channels of different points.
    whiten, back : ndarray, (channel, channel)
        Inverse square root of the correlation of the channels in use, and its inverse.
    norm : ndarray, (channel, channel)
        ``whiten`` transposed times ``whiten``.
    """

    correlation: Array
    whiten: Array
    back: Array
    norm: Array

    @classmethod
    def of(cls, correlation: Array, live: list[int]) -> Mixing:
        """Find the roots for the channels in use; the others stand by themselves."""
        count = len(correlation)
        used = np.zeros(count, dtype=bool)
        used[live] = True
        held = np.where(np.outer(used, used), correlation, 0.0)
        held[np.arange(count), np.arange(count)] = 1.0
        whiten, back = np.eye(count), np.eye(count)
        for own in _blocks(held):
            values, vectors = np.linalg.eigh(held[np.ix_(own, own)])
            root = np.sqrt(np.maximum(values, _SINGULAR))
            whiten[np.ix_(own, own)] = (vectors / root) @ vectors.T
            back[np.ix_(own, own)] = (vectors * root) @ vectors.T
        return cls(correlation, whiten, back, whiten.T @ whiten)

    def left(self, live: list[int]) -> Mixing:
        """Return the mixing of fewer channels."""
        return Mixing.of(self.correlation, live)


def _blocks(held: Array) -> list[NDArray[np.intp]]:
    """Return the sets of more than one channel that are correlated."""
    linked = held != 0.0
    made, seen = [], np.zeros(len(held), dtype=bool)
    for channel in np.flatnonzero(np.sum(linked, axis=1) > 1):
        if not seen[channel]:
            own = np.flatnonzero(linked[channel])
            seen[own] = True
            made.append(own)
    return made


def slots(points: tuple[str, ...], directions: Array, live: list[int]) -> NDArray[np.int64] | None:
    """Return the channels (point, beam) of all points in use, -1 where missing.

    Beams within 8 degrees of each other are one. None when a point has two of them, there are fewer than
    two beams or four points, or more beams than a point could have in common.
    """
    beams: list[Array] = []
    place: dict[tuple[str, int], int] = {}
    for channel in live:
        near = (k for k, beam in enumerate(beams) if float(directions[channel] @ beam) > _SAME_BEAM)
        kind = next(near, len(beams))
        if kind == len(beams):
            beams.append(directions[channel])
        if len(beams) > 6 or (points[channel], kind) in place:
            return None
        place[points[channel], kind] = channel
    names = list(dict.fromkeys(points[channel] for channel in live))
    if len(beams) < 2 or len(names) < _LEAST_POINTS:
        return None
    table = np.full((len(names), len(beams)), -1)
    for (name, kind), channel in place.items():
        table[names.index(name), kind] = channel
    return table


def point_covariance(residual: ComplexArray, span: Array, table: NDArray[np.int64]) -> Array | None:
    """Return the noise covariance (beam, beam) of the beams of a point, the same at all points.

    Parameters
    ----------
    residual : ndarray, (channel, sample), complex
        What a fit with orthonormal columns ``span`` (channel, m) leaves of noise.
    span : ndarray
    table : ndarray, (point, beam), int
        Channels; -1 where missing.

    Returns
    -------
    ndarray or None
        None without samples, or when the residuals do not determine it.

    Notes
    -----
    The residuals of noise of covariance C have P C P, P = I - span span^T; the sum of their blocks of one
    point is linear in C and is solved for it. Points of more residual than the median weigh less.
    """
    count, kinds = table.shape
    if residual.shape[1] < 8:
        return None
    own = np.where(table[..., None] >= 0, residual[table], 0.0)
    energy = np.sum(np.abs(own) ** 2, axis=(1, 2))
    weight = np.median(energy) / np.maximum(energy, np.median(energy)) if np.median(energy) > 0.0 else None
    if weight is None:
        return None
    seen = np.real(np.einsum("p,pks,pls->kl", weight, own, own.conj())) / residual.shape[1]
    part = np.where(table[..., None] >= 0, span[table], 0.0)
    project = -np.einsum("pkm,qlm->pqkl", part, part)
    index = np.arange(count)
    project[index, index] += np.eye(kinds)[None] * (table >= 0)[:, None, :]
    project = project * (table >= 0)[None, :, None, :]
    system = np.einsum("p,pqik,pqjl->ijkl", weight, project, project, optimize=True)
    flat = system.reshape(kinds**2, kinds**2)
    if np.linalg.cond(flat) > 1e6:
        return None
    found = np.linalg.solve(flat, seen.ravel()).reshape(kinds, kinds)
    found = 0.5 * (found + found.T)
    return found if np.all(np.diag(found) > 0.0) else None


def correlated(covariance: Array, values: float) -> Array | None:
    """Return the correlation (beam, beam), or None when chance may have made it.

    Parameters
    ----------
    covariance : ndarray, (beam, beam)
    values : float
        Number of complex values of each beam behind it.
    """
    from scipy.special import chdtrc

    sd = np.sqrt(np.diag(covariance))
    held = covariance / np.outer(sd, sd)
    off = held[np.triu_indices(len(held), 1)]
    if np.max(np.abs(off)) < _LEAST_CORRELATION:
        return None
    if chdtrc(len(off), 2.0 * values * float(np.sum(off**2))) > _LIKELY:
        return None
    parts, vectors = np.linalg.eigh(held)
    held = (vectors * np.maximum(parts, _SINGULAR)) @ vectors.T
    sd = np.sqrt(np.diag(held))
    return np.asarray(held / np.outer(sd, sd))


def spread_out(correlation: Array, table: NDArray[np.int64], channels: int) -> Array:
    """Return the correlation of all channels (channel, channel) from that of the beams of a point."""
    whole = np.eye(channels)
    for own in table:
        held = np.flatnonzero(own >= 0)
        whole[np.ix_(own[held], own[held])] = correlation[np.ix_(held, held)]
    return whole
