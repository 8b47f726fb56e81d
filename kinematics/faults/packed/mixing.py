"""Noise that the channels of a point have in common, as x, y, z solved from three oblique beams have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_SAME_BEAM = float(np.cos(np.radians(8.0)))
_LEAST_SAMPLES = 24
_MOST_AT_POINT = 6
_CORRECTIONS = 15
_MOST_CORRECTED = 150
_LIKELY = 1e-3
_SINGULAR = 0.05
_SHRINK = 5.0


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


def axes_of(directions: Array, live: list[int]) -> list[list[int]]:
    """Return the channels in use of each beam direction; beams within 8 degrees of each other are one."""
    groups: list[list[int]] = []
    left = np.array(live, dtype=np.intp)
    while len(left):
        near = directions[left] @ directions[left[0]] > _SAME_BEAM
        near[0] = True
        groups.append(left[near].tolist())
        left = left[~near]
    return groups


def block_covariance(
    residual: ComplexArray, project: Array, points: tuple[str, ...], live: list[int]
) -> Array | None:
    """Return the noise covariance (channel, channel) within each point, zero between points.

    Parameters
    ----------
    residual : ndarray, (channel, sample), complex
        What a fit leaves: noise times ``project``.
    project : ndarray, (channel, channel)
        From the noise of all channels to the residuals.
    points : tuple of str, (channel,)
    live : list of int
        Channels in use.

    Returns
    -------
    ndarray or None
        None when there are too few samples, or points with more than one channel, to tell.

    Notes
    -----
    Residuals of noise of covariance C have the covariance Q C Q^T; the blocks of C are found by repeated
    correction of those measured.
    """
    samples = residual.shape[1]
    own = _points(points, live)
    if samples < _LEAST_SAMPLES or len(own) < 2 or max(map(len, own)) > _MOST_AT_POINT:
        return None
    held = np.zeros(project.shape)
    for channels in _of_one_size([[c] for c in live] + [channels.tolist() for channels in own]):
        part = residual[channels]
        products = part.real @ part.real.swapaxes(1, 2) + part.imag @ part.imag.swapaxes(1, 2)
        held[channels[:, :, None], channels[:, None, :]] = products / samples
    if len(project) > _MOST_CORRECTED:
        return held if np.all(np.diag(held)[live] > 0.0) else None
    wanted = np.zeros(project.shape, dtype=bool)
    for channels in own:
        wanted[np.ix_(channels, channels)] = True
    wanted[live, live] = True
    found = held.copy()
    for _ in range(_CORRECTIONS):
        found = found + np.where(wanted, held - project @ found @ project.T, 0.0)
    return found if np.all(np.diag(found)[live] > 0.0) else None


def scaled(covariance: Array, samples: float = np.inf) -> tuple[Array, Array]:
    """Return the correlation (channel, channel) and the standard deviations (channel,); 1 where none.

    With few samples it is shrunk towards none, so that its inverse is not too large.
    """
    size = np.diag(covariance)
    sd = np.sqrt(np.where(size > 0.0, size, 1.0))
    made = covariance / np.outer(sd, sd) / (1.0 + _SHRINK / samples)
    np.fill_diagonal(made, 1.0)
    return made, sd


def by_chance(
    correlation: Array, kept: Array, points: tuple[str, ...], live: list[int], samples: int
) -> bool:
    """Tell whether independent noise may show such correlations within points.

    Only the half of the points that show least is looked at: a single channel with more noise is no
    correlation of all.

    Parameters
    ----------
    correlation : ndarray, (channel, channel)
    kept : ndarray, (channel,)
        Share of each channel's noise that the residuals keep, 1 - leverage.
    points : tuple of str, (channel,)
    live : list of int
    samples : int

    Notes
    -----
    2 N r^2 of a correlation r of N complex values is then chi-squared with one degree of freedom; those
    of residuals scatter more by one over what both channels keep.
    """
    from scipy.special import chdtrc

    shown, sizes = [], []
    for own in _of_one_size([channels.tolist() for channels in _points(points, live)]):
        one, two = np.triu_indices(own.shape[1], 1)
        one, two = own[:, one], own[:, two]
        shown.append(2.0 * samples * np.sum(correlation[one, two] ** 2 * kept[one] * kept[two], axis=1))
        sizes.append(np.full(len(own), own.shape[1] * (own.shape[1] - 1) // 2))
    value, size = np.concatenate(shown), np.concatenate(sizes)
    least = np.argsort(value / size, kind="stable")[: (len(value) + 1) // 2]
    return bool(chdtrc(np.sum(size[least]), np.sum(value[least])) > _LIKELY)


def _of_one_size(sets: list[list[int]]) -> list[NDArray[np.intp]]:
    """Return the sets of channels that have as many members in one array (set, n) each, small ones first."""
    sizes = sorted({len(own) for own in sets})
    return [np.array([own for own in sets if len(own) == size], dtype=np.intp) for size in sizes]


def _points(points: tuple[str, ...], live: list[int]) -> list[NDArray[np.intp]]:
    """Return the channels in use of the points that have several."""
    groups: dict[str, list[int]] = {}
    for channel in live:
        groups.setdefault(points[channel], []).append(channel)
    return [np.array(channels) for channels in groups.values() if len(channels) > 1]
