"""The motion of a body without the channels that spoil it, to compare with what any other rows hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.beams import BeamSet
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array, ComplexArray
from stapeskit.spatial import dof_indices, point_rows

Lines = NDArray[np.intp]
# Up to so many lines are all looked at; of more, about as many in groups of neighbours, for shifts by REACH.
_WHOLE = 300
_BLOCKS, REACH = 43, 3
# A point is left out when that takes this share of the misfit, and so many times what noise would.
_FALL, _TIMES = 0.3, 4.0
# One of its channels alone, when that takes nearly all of it, or what the others hold is little above noise.
_ALONE, _QUIET = 0.97, 1.4
# The weakest direction of motion must keep this share of the strongest's lever.
_HELD = 1e-3
# Weights that differ by less have the same course.
_ALIKE = 1e-12
# Points that are left out at most, and the best candidates that are tried for each.
_MOST, _TRIED = 8, 5


@dataclass(frozen=True)
class CleanMotion:
    """One body in one run.

    Attributes
    ----------
    run : int
    number : int
        Of the body.
    body : BodyChannels
    lines : ndarray, (n,), int
        The lines that were looked at.
    value, variance : ndarray, (channel, n)
        Readings, m, and variance of a complex reading, m^2; zero and infinite where missing.
    q : ndarray, (n, 6), complex
        Motion without the suspects; zero where the beams do not observe it.
    covariance : ndarray, (n, 6, 6)
        Complex covariance E[dq dq^H].
    suspects : tuple of tuple of int
        Channels of a point, or single ones, without which the others agree much better.
    level : float
        Residual energy of the others over that of the stated noise.
    """

    run: int
    number: int
    body: BodyChannels
    lines: Lines
    value: ComplexArray
    variance: Array
    q: ComplexArray
    covariance: Array
    suspects: tuple[tuple[int, ...], ...]
    level: float

    def rows(self, arms_m: Array, directions: Array) -> Array:
        """Return observation rows (k, 6) of beams at a place (3,) on this body."""
        return point_rows(np.broadcast_to(arms_m, directions.shape), directions)


def chosen_lines(good: NDArray[np.bool_]) -> Lines:
    """Return the determined lines, of all (freq,), or, of many, evenly spread groups of neighbours."""
    lines = np.flatnonzero(good)
    if len(lines) <= _WHOLE:
        return lines
    starts = np.linspace(REACH, len(lines) - 1 - REACH, _BLOCKS).round().astype(int)
    return np.asarray(lines[np.unique(starts[:, None] + np.arange(-REACH, REACH + 1))])


def fit_clean_motion(
    key: tuple[int, int], fit: LineFit, body: BodyChannels, beams: BeamSet, sd: Array, lines: Lines
) -> CleanMotion:
    """Leave out one point after the other as long as that explains much of what is left.

    Parameters
    ----------
    key : (int, int)
        Run and body.
    fit : LineFit
        Holds the readings.
    body : BodyChannels
    beams : BeamSet
        For all degrees of freedom that are observed.
    sd : ndarray, (channel, n)
        Standard deviations of the lines, m.
    lines : ndarray, (n,), int
    """
    value = fit.value[:, lines]
    used = np.isfinite(value) & np.isfinite(sd)
    value = np.where(used, value, 0.0)
    variance = np.where(used, 2.0 * sd**2, np.inf)
    weight = 1.0 / variance
    basis = beams.basis
    sums = _Sums(basis, weight, value)
    groups: dict[str, list[int]] = {}
    for channel, name in enumerate(body.points):
        groups.setdefault(name, []).append(channel)
    suspects: list[tuple[int, ...]] = []
    out: list[int] = []
    names = list(groups)
    for _ in range(min(max(1, len(groups) // 3), _MOST)):
        before, freedom = sums.left(out), sums.freedom(out)
        if freedom <= 0:
            break
        left = sums.left_without(out, [groups[name] for name in names])
        order = np.argsort(left, kind="stable")
        best = next((k for k in order[:_TRIED] if sums.determined([*out, *groups[names[k]]])), None)
        if best is None:
            break
        own, after = groups[names.pop(best)], float(left[best])
        fall = before - after
        noise = max(after / max(sums.freedom([*out, *own]), 1), 1e-300)
        if fall < _FALL * before or fall < _TIMES * noise * len(own) * len(lines):
            break
        for channel in own if len(own) > 1 else ():
            alone = before - sums.left([*out, channel])
            if alone > _ALONE * fall or fall - alone < _QUIET * noise * (len(own) - 1) * len(lines):
                own = [channel]
                break
        suspects.append(tuple(own))
        out += own
    z, inverse = sums.motion(out)
    places = dof_indices(beams.dof)
    q = np.zeros((len(lines), 6), dtype=complex)
    q[:, places] = z @ beams.to_dof.T
    covariance = np.zeros((len(lines), 6, 6))
    covariance[np.ix_(range(len(lines)), places, places)] = beams.to_dof @ inverse @ beams.to_dof.T
    level = sums.left(out) / max(sums.freedom(out), 1)
    return CleanMotion(*key, body, lines, value, variance, q, covariance, tuple(suspects), level)


class _Sums:
    """Normal equations of all lines, from which channels can be taken."""

    def __init__(self, basis: Array, weight: Array, value: ComplexArray) -> None:
        self.basis, self.weight = basis, weight
        self.start = np.zeros((weight.shape[1], basis.shape[1]), dtype=complex)
        self.value = value
        for _ in range(2):
            residual = value - basis @ self.start.T
            gram, side = self._of(range(len(basis)), residual)
            self.start = self.start + _solved(gram, side)
        self.value = value - basis @ self.start.T
        self.gram, self.side = self._of(range(len(basis)), self.value)

    def _of(self, channels: range | list[int], value: ComplexArray) -> tuple[Array, ComplexArray]:
        own = list(channels)
        rows, weight = self.basis[own], self.weight[own]
        gram = np.einsum("cf,ca,cb->fab", weight, rows, rows, optimize=True)
        return gram, np.einsum("cf,ca->fa", weight * value[own], rows, optimize=True)

    def _without(self, out: list[int]) -> tuple[Array, ComplexArray]:
        gram, side = self._of(out, self.value)
        return self.gram - gram, self.side - side

    def left(self, out: list[int]) -> float:
        """Return the residual energy without some channels."""
        gram, side = self._without(out)
        kept = [c for c in range(len(self.basis)) if c not in set(out)]
        whole = float(np.sum(self.weight[kept] * np.abs(self.value[kept]) ** 2))
        return whole - float(np.real(np.sum(side.conj() * _solved(gram, side))))

    def left_without(self, out: list[int], groups: list[list[int]]) -> Array:
        """Return the residual energy without some channels and each of some groups, (group,)."""
        gram, side = self._without(out)
        energy = np.sum(self.weight * np.abs(self.value) ** 2, axis=1)
        whole = float(np.sum(energy) - np.sum(energy[out]))
        energies = np.empty(len(groups))
        line = _common(self.weight)
        if line is not None:
            for size in {len(own) for own in groups}:
                same = [k for k, own in enumerate(groups) if len(own) == size]
                at = np.array([groups[k] for k in same])
                energies[same] = (
                    whole - np.sum(energy[at], axis=1) - self._taken_without(gram, side, at, line)
                )
            return energies
        for k, own in enumerate(groups):
            less, shorter = self._of(own, self.value)
            rest, into = gram - less, side - shorter
            taken = float(np.real(np.sum(into.conj() * _solved(rest, into))))
            energies[k] = whole - float(np.sum(energy[own])) - taken
        return energies

    def _taken_without(self, gram: Array, side: ComplexArray, at: NDArray[np.intp], line: Array) -> Array:
        """Return what the motion takes (group,) without each of some groups (group, n) of channels.

        All weights have the same course over the lines: ``line`` (f,) times those at the first.
        """
        rows = self.basis[at]
        weighted = self.weight[at]
        rest = gram[0] - rows.swapaxes(1, 2) @ (weighted[:, :, :1] * rows)
        into = side.T - rows.swapaxes(1, 2) @ (weighted * self.value[at])
        return np.real(np.einsum("gmf,gmf->g", into.conj(), _divided(rest, into / line)))

    def freedom(self, out: list[int]) -> int:
        """Return how many complex values are left over."""
        kept = [c for c in range(len(self.basis)) if c not in set(out)]
        return int(np.sum(self.weight[kept] > 0.0)) - self.side.size

    def determined(self, out: list[int]) -> bool:
        """Return whether the motion is still well determined without some channels."""
        gram = self._without(out)[0]
        weakest = np.linalg.eigvalsh(gram)[:, 0]
        return bool(np.median(weakest / np.linalg.eigvalsh(self.gram)[:, -1]) > _HELD**2)

    def motion(self, out: list[int]) -> tuple[ComplexArray, Array]:
        """Return the motion (line, m) in the basis and the inverse normal matrices."""
        gram, side = self._without(out)
        inverse = np.asarray(np.linalg.pinv(gram, rcond=1e-14, hermitian=True), dtype=float)
        return self.start + _solved(gram, side), inverse


def _common(weight: Array) -> Array | None:
    """Return the course (f,) of weights (channel, f) over the lines, from 1, when all channels share it."""
    first = weight[:, 0]
    heaviest = int(np.argmax(first))
    if not first[heaviest] > 0.0:
        return None
    line = weight[heaviest] / first[heaviest]
    alike = np.abs(weight - first[:, None] * line) <= _ALIKE * first[heaviest] * line
    return line if bool(np.all(line > 0.0) and np.all(alike)) else None


def _divided(gram: Array, side: ComplexArray) -> ComplexArray:
    """Solve matrices (k, m, m) for sides (k, m, n); by pseudo-inverses where one has no solution."""
    try:
        return np.asarray(np.linalg.solve(gram, side))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(gram, rcond=1e-14, hermitian=True) @ side)


def _solved(gram: Array, side: ComplexArray) -> ComplexArray:
    """Solve the normal equations (line, m, m) of every line; by pseudo-inverses where one has no solution."""
    try:
        return np.asarray(np.linalg.solve(gram, side[..., None])[..., 0])
    except np.linalg.LinAlgError:
        inverse = np.linalg.pinv(gram, rcond=1e-14, hermitian=True)
        return np.asarray(np.einsum("fab,fb->fa", inverse, side))


__all__ = ["REACH", "CleanMotion", "chosen_lines", "fit_clean_motion"]
