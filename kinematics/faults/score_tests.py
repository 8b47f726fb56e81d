"""Score tests of all faults at once, from a few cross-products of residuals and motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.fault_kinds import across
from kinematics.faults.fault_model import State
from kinematics.faults.refit import Places
from stapeskit.spatial import dof_indices, point_rows

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Batch:
    """Faults of one kind at many places: B sets of n channels whose rows change together by k parameters.

    Attributes
    ----------
    kind, owner : str
        As of a Fault.
    channels : ndarray, (B, n), int
    slopes : ndarray, (B, k, n, m)
        Derivatives of the whitened rows.
    lines : str
        What the change is multiplied with from line to line: nothing, ``tau`` (drift: constant and slope) or
        ``freq`` (delay).
    """

    kind: str
    owner: str
    channels: NDArray[np.int64]
    slopes: ComplexArray | Array
    lines: str = ""


@dataclass(frozen=True)
class Tested:
    """The score tests of a batch: statistics (B,), chi-squared with ``freedom`` (B,) degrees of freedom."""

    batch: Batch
    statistic: Array
    freedom: NDArray[np.int64]
    information: Array

    def p_values(self, scale: float = 1.0) -> Array:
        """Return the probability (B,) of such statistics when the noise variance is ``scale``."""
        from scipy.special import chdtrc

        return np.asarray(chdtrc(np.maximum(self.freedom, 1), np.maximum(self.statistic, 0.0) / scale))


class ScoreTests:
    """The cross-products of one fit, and the tests they give.

    Notes
    -----
    For a change D of the whitened rows the score is Re tr(D^H G) with G = e z^H, and the information of two
    of them Re tr(D^H P D' T) with P the projector on the residual space and T = z z^H (Rao 1948,
    doi:10.1017/S0305004100023987,
    for complex noise; faults as changes of rows). Position errors of a stated size are marginalised:
    I - X (N + 1 / (2 sd^2))^-1 X^T, N their own information and X that in common. ``settled``: the points
    stand at their most probable positions; otherwise the score of their shifts is marginalised too.
    """

    def __init__(self, state: State, places: Places, settled: bool = True) -> None:
        self.state, self.places = state, places
        data = state.data
        ratio = data.freq_hz / np.mean(data.freq_hz)
        weights = {"": None, "tau": data.tau, "freq": ratio}
        self.g = {name: state.score(weight) for name, weight in weights.items()}
        self.t = {name: state.motion(weight) for name, weight in weights.items()}
        for name in ("tau", "freq"):
            weight = weights[name]
            self.t[name + name] = state.motion(None if weight is None else weight**2)
        self.a = data.a
        self.rows = data.a[:, None] * data.beams.basis
        self.norm = state.norm
        self.turns = self._turns()
        shape = self.turns.shape
        self.mixed = self.turns
        if self.norm is not None:
            self.mixed = (self.norm @ self.turns.reshape(shape[0], -1)).reshape(shape)
        if places.owners:
            self._marginal(settled)

    def _turns(self) -> Array:
        """Return the whitened derivatives (channel, 3, m) of all rows by a shift of their points."""
        data = self.state.data
        turned = np.cross(np.eye(3)[None], data.directions[:, None])
        change = np.concatenate([np.zeros_like(turned), turned], axis=2)
        rows = change[..., dof_indices(data.beams.dof)] @ data.beams.to_dof
        return np.asarray(self.a[:, None, None] * rows)

    def _marginal(self, settled: bool) -> None:
        """Prepare the information of the positions with their prior."""
        places, count = self.places, len(self.places.owners)
        channels = [c for owner in places.owners for c in owner]
        owner = np.repeat(np.arange(count), [len(own) for own in places.owners])
        d = self.turns[channels]
        half = np.linalg.cholesky(self.t[""] + 1e-12 * np.trace(self.t[""]) * np.eye(len(self.t[""])))
        own, mixed = d @ half, self.mixed[channels] @ half
        starts = np.flatnonzero(np.diff(owner, prepend=-1))
        blocks = np.add.reduceat(own @ mixed.swapaxes(1, 2), starts, axis=0)
        span = (own[..., None] * self.state.own_span[channels][:, None, None]).reshape(len(channels), 3, -1)
        flat = np.add.reduceat(span, starts, axis=0).reshape(3 * count, -1)
        blocks[:, np.arange(3), np.arange(3)] += 0.5 / places.sd_m[:, None] ** 2
        self.inner = _inverse(blocks, flat)
        self.half, self.flat, self.low = half, flat, self.inner @ flat
        self.number_of = np.full(len(self.a), -1)
        self.number_of[channels] = owner
        self.shift_score = np.zeros((count, 3))
        if not settled:
            own_score = np.real(np.einsum("cim,cm->ci", d, self.g[""][channels]))
            np.add.at(self.shift_score, owner, own_score)

    def run(self, batch: Batch) -> Tested:
        """Run the score tests of a batch."""
        score, information = self.parts(batch)
        size = score.shape[1]
        norm = np.sqrt(np.maximum(np.einsum("bkk->bk", information), 0.0))
        scale = np.where(norm > 1e-145, 1.0 / np.maximum(norm, 1e-145), 0.0)
        even = information * scale[:, :, None] * scale[:, None, :]
        values, vectors = (even[..., 0], np.ones_like(even)) if size == 1 else np.linalg.eigh(even)
        good = (values > 1e-6) & (np.max(norm, axis=1, keepdims=True) > 1e-140)
        along = ((score * scale)[:, None] @ vectors)[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            statistic = 2.0 * np.sum(np.where(good, along**2 / values, 0.0), axis=1)
        return Tested(batch, statistic, np.minimum(np.sum(good, axis=1), size), 2.0 * information)

    def parts(self, batch: Batch) -> tuple[Array, Array]:
        """Return score (B, k) and information (B, k, k) for residuals of unit complex variance."""
        d, channels = batch.slopes, batch.channels
        names = ["", "tau"] if batch.kind == "drift" else [batch.lines]
        span = self.state.own_span[channels]
        norm = None if self.norm is None else self.norm[channels[:, :, None], channels[:, None, :]]
        score = np.concatenate([self._along(d, self.g[name][channels]) for name in names], axis=1)
        pairs = [[one + two if one and two else one or two for two in names] for one in names]
        each = dict.fromkeys(name for row in pairs for name in row)
        found = {name: _information(d, span, self.t[name], norm) for name in each}
        blocks = [[found[name] for name in row] for row in pairs]
        information = np.concatenate([np.concatenate(row, axis=2) for row in blocks], axis=1)
        if self.places.owners:
            seen = np.concatenate([self._seen(d, span, name) for name in names], axis=1)
            owners = self.number_of[channels]
            if np.all(owners == owners[:, :1]):
                common = np.concatenate([self._common(d, channels, name) for name in names], axis=1)
                taken, held = self._at_points(seen, common, owners[:, 0])
            else:
                crossed = np.concatenate([self._crossed(d, channels, name) for name in names], axis=1)
                crossed -= seen @ self.flat.T
                held = (crossed.reshape(-1, len(self.inner)) @ self.inner).reshape(crossed.shape)
                taken = held @ crossed.swapaxes(1, 2)
                held = held @ self.shift_score.ravel()
            score, information = score - held, information - taken
        return score, information

    @staticmethod
    def _along(d: ComplexArray | Array, g: ComplexArray) -> Array:
        flat = d.conj().reshape(*d.shape[:2], -1) @ g.reshape(len(g), -1, 1)
        return np.asarray(flat[..., 0].real)

    def _seen(self, d: ComplexArray | Array, span: Array, name: str) -> Array:
        """Return what the motion can take of changes (B, k, m m), in the coordinates of ``flat``."""
        back = np.linalg.solve(self.half, self.t[name]).T
        return np.asarray(_outer(_times(d.real, np.asarray(back)), span).real)

    def _common(self, d: ComplexArray | Array, channels: NDArray[np.int64], name: str) -> Array:
        """Return the products (B, k, 3) of changes with the shifts of the one point that has the channels."""
        moved = _times(d.real, self.t[name]).reshape(*d.shape[:2], -1)
        mixed = self.mixed[channels].swapaxes(1, 2).reshape(len(channels), 3, -1)
        return np.asarray(moved @ mixed.swapaxes(1, 2))

    def _at_points(self, seen: Array, common: Array, owner: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return what the positions take of information (B, k, k) and score (B, k) of sets at one point each.

        With X = C at the point less seen F^T: X M X^T and X M s, M the covariance of the positions.
        """
        count, low, at = len(self.places.owners), self.low, np.arange(len(self.places.owners))
        own = self.inner.reshape(count, 3, count, 3)[at, :, at]
        common = np.where((owner >= 0)[:, None, None], common, 0.0)
        both = seen @ low.reshape(count, 3, -1)[owner].swapaxes(1, 2)
        cross = both @ common.swapaxes(1, 2)
        taken = (seen @ (self.flat.T @ low)) @ seen.swapaxes(1, 2)
        taken += (common @ own[owner]) @ common.swapaxes(1, 2) - cross - cross.swapaxes(1, 2)
        moved = self.inner @ self.shift_score.ravel()
        held = (common @ moved.reshape(count, 3)[owner][..., None])[..., 0] - seen @ (self.flat.T @ moved)
        return taken, held

    def _crossed(self, d: ComplexArray | Array, channels: NDArray[np.int64], name: str) -> Array:
        """Return the products (B, k, 3 point) of changes with the shifts of all points."""
        sets, count = d.shape[:2]
        common = (d.real @ self.t[name]).swapaxes(1, 2) @ self.mixed[channels].swapaxes(2, 3)
        made = np.zeros((sets, len(self.places.owners), count, 3))
        of_set, place = np.nonzero(self.number_of[channels] >= 0)
        np.add.at(made, (of_set, self.number_of[channels][of_set, place]), common[of_set, place])
        return made.swapaxes(1, 2).reshape(sets, count, -1)


def _inverse(blocks: Array, low: Array) -> Array:
    """Return the inverse of the matrix of ``blocks`` (point, 3, 3) less low low^T (Woodbury 1950)."""
    count, rank = low.shape
    at, own = np.arange(len(blocks)), np.zeros((len(blocks), 3, len(blocks), 3))
    if rank > count // 2:
        own[at, :, at] = blocks
        return np.asarray(np.linalg.inv(own.reshape(count, count) - low @ low.T))
    inner = np.linalg.inv(blocks)
    own[at, :, at] = inner
    turned = (inner @ low.reshape(len(blocks), 3, -1)).reshape(low.shape)
    return np.asarray(
        own.reshape(count, count) + turned @ np.linalg.solve(np.eye(rank) - low.T @ turned, turned.T)
    )


def _times(d: NDArray[Any], t: Array) -> NDArray[Any]:
    """Return changes (B, k, n, m) of rows times a matrix."""
    return np.asarray((d.reshape(-1, d.shape[-1]) @ t).reshape(d.shape))


def _outer(d: NDArray[Any], span: Array) -> NDArray[Any]:
    """Return the sums over channels of changes (B, k, n, m) times their span (B, n, r), (B, k, m r)."""
    turned, beside = d.swapaxes(2, 3), span[:, None]
    made = turned * beside if d.shape[2] == 1 else turned @ beside
    return np.asarray(made.reshape(*d.shape[:2], -1))


def _information(d: ComplexArray | Array, span: Array, t: Array, norm: Array | None) -> Array:
    sets, count = d.shape[:2]
    left = _times(d, t)
    mixed = d if norm is None else norm[:, None] @ d
    whole = left.reshape(sets, count, -1) @ mixed.conj().reshape(sets, count, -1).swapaxes(1, 2)
    seen, other = _outer(left, span), _outer(d.conj(), span)
    return np.asarray(np.real(whole - seen @ other.swapaxes(1, 2)))


def batches(
    tests: ScoreTests, channels: list[int], points: list[list[int]], lasers: list[list[int]]
) -> list[Batch]:
    """Return the faults of single channels, of points and of lasers.

    Parameters
    ----------
    tests : ScoreTests
    channels : list of int
        Channels to test by themselves.
    points, lasers : list of list of int
        Channels of each point, of each laser.
    """
    made: list[Batch] = []
    if channels:
        made += _common(tests, np.array(channels)[:, None], "channel")
    for size in sorted({len(own) for own in points}):
        same = np.array([own for own in points if len(own) == size])
        made.append(Batch("position", "point", same, tests.turns[same].transpose(0, 2, 1, 3)))
        if size > 1:
            made += _common(tests, same, "point")
    for own in lasers:
        made += _common(tests, np.array(own)[None], "laser")
    return made


def _common(tests: ScoreTests, channels: NDArray[np.int64], owner: str) -> list[Batch]:
    """Return the factors that sets of channels can have, and the turn of parallel beams."""
    own = tests.rows[channels][:, None]
    both = np.asarray(np.concatenate([own, 1j * own], axis=1), dtype=complex)
    made = [Batch("gain", owner, channels, own), Batch("phase", owner, channels, both)]
    if len(np.unique(tests.state.data.part)) >= 4:
        made.append(Batch("delay", owner, channels, np.asarray(-1j * own, dtype=complex), "freq"))
        made.append(Batch("drift", owner, channels, both, "tau"))
    if owner != "point":
        made.append(Batch("direction", owner, channels, _turned(tests, channels)))
    return made


def _turned(tests: ScoreTests, channels: NDArray[np.int64]) -> Array:
    """Return the whitened derivatives (B, 2, n, m) by the two angles across parallel beams."""
    data = tests.state.data
    places = dof_indices(data.beams.dof)
    sides = np.stack(across(data.directions[channels[:, 0]]), axis=1)
    made = []
    for k in range(2):
        turned = np.repeat(sides[:, k][:, None], channels.shape[1], axis=1)
        rows = point_rows(data.arms_m[channels].reshape(-1, 3), turned.reshape(-1, 3))
        rows = rows[:, places] @ data.beams.to_dof
        made.append(tests.a[channels][..., None] * rows.reshape(*channels.shape, -1))
    return np.stack(made, axis=1)


def any_batches(tests: ScoreTests, channels: list[int], points: list[list[int]]) -> list[Batch]:
    """Return any change at all of the rows of single channels, and of all channels of single points."""
    size = tests.rows.shape[1]
    free = np.concatenate([np.eye(size), 1j * np.eye(size)])
    made = []
    for owner, sets in (("channel", [[c] for c in channels]), ("point", points)):
        for number in sorted({len(own) for own in sets}):
            same = np.array([own for own in sets if len(own) == number])
            slopes = np.zeros((len(same), number, 2 * size, number, size), dtype=complex)
            for place in range(number):
                slopes[:, place, :, place] = tests.a[same[:, place]][:, None, None] * free
            flat = slopes.reshape(len(same), 2 * size * number, number, size)
            made.append(Batch("any", owner, same, flat))
    return made


def axes_batch(tests: ScoreTests) -> Batch:
    """Return the turn of all beams against the positions."""
    data = tests.state.data
    channels = np.array(data.live)
    places = dof_indices(data.beams.dof)
    made = []
    for axis in np.eye(3):
        rows = point_rows(data.arms_m[channels], np.cross(axis, data.directions[channels]))
        made.append(tests.a[channels][:, None] * (rows[:, places] @ data.beams.to_dof))
    return Batch("axes", "body", channels[None], np.stack(made)[None])
