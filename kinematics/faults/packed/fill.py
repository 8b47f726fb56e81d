"""What stands in place of missing readings: what a channel's other lines show, whatever fault it has.

Lines are packed as unitary mixtures (faults/packed), which needs a reading of every channel at
every line. The motion of a line with gaps follows a fault more closely where the channel was measured than
where it is missing; of a large fault that is a pattern of its own that no fault of one channel makes. Faults
that last change the rows B of y = B z + noise to others, A, and leave the rank as it is: where they are
large, rows and motion are found together from the readings that there are, and A z fills the gaps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.packed.known_share import LEAST, brought, shares_of
from kinematics.faults.packed.whole_lines import mixed_whole, motion_whole
from kinematics.fit.line_noise import blocks

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Held = NDArray[np.bool_]
# Lines on which rows and motion are found together, and rounds of it; done when the misfit falls by less.
_SAMPLE, _ROUNDS, _SETTLED = 480, 100, 2e-4
# Changes of a row are held to so many times its size, motion to so many times its variance: hardly at all.
_WIDTH, _LOOSE = 4.0, 10.0
# Measurements of fewer values go one way, those with and without gaps together.
_SHORT = 20_000
# Share of noise below which nothing is divided.
_KEPT = 0.1
# Lines for each parameter of a channel's change.
_LINES = 3
# Chance below which a change of rows is clear.
_CLEAR = 1e-5
# The misfit must fall by so many times, unless a channel reads something other by this share.
_LEAK, _ANOTHER = 4.0, 0.4


@dataclass(frozen=True)
class Filled:
    """The motion that readings with gaps show, and what fills these.

    Attributes
    ----------
    z : ndarray, (m, line), complex
        Motion that the filled readings show with the rows as given.
    basis : ndarray, (channel, m)
        The rows as given.
    moved : ndarray, (m, line), complex
        Motion that the readings show with the rows as found.
    change : ndarray, (channel, 2 m), complex
        Change of the rows, constant and in proportion to ``tau``.
    tau : ndarray, (line,)
        Place in the measurement, -1 to 1.
    share : ndarray, (channel,)
        Share of the information on the rows that is left.
    measured : ndarray, (channel,)
        Share of the lines that was measured.
    kept : ndarray, (channel,)
        Share of the noise that residuals keep at lines with gaps, relative to those without.
    """

    z: ComplexArray
    basis: Array
    moved: ComplexArray
    change: ComplexArray
    tau: Array
    share: Array
    measured: Array
    kept: Array

    def residual(self, lines: NDArray[np.intp], some: Held | slice = slice(None)) -> ComplexArray:
        """Return what stands for the residuals (channel, n) of missing values at some lines."""
        moved = self.moved[:, lines]
        made = self.change[some] @ _varying(moved, self.tau[lines])
        if self.moved is not self.z:
            made += self.basis[some] @ (moved - self.z[:, lines])
        return np.asarray(made)

    def evened(self, error: ComplexArray, motion: ComplexArray, tau: Array) -> ComplexArray:
        """Return packed residuals (channel, n) of equal noise, whether they follow the motion or not.

        The filled part has no noise of its own; what follows the ``motion`` (m, n) holds all there is to know
        of the rows already, but that the motion of lines with gaps follows a fault more closely.
        """
        span = np.linalg.svd(_varying(motion, tau), full_matrices=False)
        keep = span[1] > 1e-9 * max(float(np.max(span[1], initial=0.0)), 1e-300)
        along = (error @ span[2][keep].conj().T) @ span[2][keep]
        more = 1.0 / self.kept[:, None] if self.moved is self.z else 1.0
        return np.asarray(along * more + (error - along) * self.lift[:, None])

    @property
    def lift(self) -> Array:
        """What residuals apart from the motion are multiplied with, (channel,)."""
        return np.asarray(1.0 / np.sqrt(np.maximum(self.share * self.kept * self.measured, LEAST)))


def _varying(z: ComplexArray, tau: Array) -> ComplexArray:
    return np.vstack([z, tau * z])


@dataclass(frozen=True)
class Gaps:
    """Readings with gaps.

    Attributes
    ----------
    value : ndarray, (channel, line), complex
    held : ndarray, (channel, line), bool
        Where it is used.
    good : ndarray, (k,), int
        Lines that are packed.
    line : ndarray, (line,)
        Weights of the lines.
    tau : ndarray, (line,)
        Place of each among those that are packed, -1 to 1.
    basis : ndarray, (channel, m)
    a : ndarray, (channel,)
        One over the standard deviation; zero for channels not used.
    divisor : ndarray, (channel, segment), complex
        What readings are divided by.
    segment : ndarray, (line,), int
    """

    value: ComplexArray
    held: Held
    good: NDArray[np.intp]
    line: Array
    tau: Array
    basis: Array
    a: Array
    divisor: ComplexArray
    segment: NDArray[np.intp]

    def filled(self) -> Filled:
        """Find the motion, and rows and motion together where that fits the readings better."""
        z, kept = self._given()
        count = max(len(self.good), 1)
        pick = self.good[np.unique(np.linspace(0, count - 1, min(_SAMPLE, count)).round().astype(int))]
        change, left, clear = self._regressed(pick, z[:, pick])
        moved = z
        if clear:
            loose = self._loose(z[:, pick])
            found, less = self._together(pick, change, left, loose)
            if left > (1.0 if self._large(pick, z[:, pick], change) else _LEAK) * less:
                z, moved = self._motion(z, found, loose)
        change, share = self._settled(moved)
        measured = np.mean(self.held[:, self.good], axis=1)
        return Filled(z, self.basis, moved, change, self.tau, share * kept, measured, kept)

    def residual(self, filled: Filled, lines: NDArray[np.intp]) -> ComplexArray:
        """Return the residuals (channel, n) of some lines, filled where missing."""
        made = np.empty((len(self.a), len(lines)), dtype=complex)
        for part in blocks(*made.shape):
            some = lines[part]
            held = self.held[:, some] & (self.a > 0.0)[:, None]
            made[:, part] = np.where(
                held, self._values(some) - self.basis @ filled.z[:, some], filled.residual(some)
            )
        return made

    def mixed(self, filled: Filled, lines: NDArray[np.intp], vectors: ComplexArray) -> ComplexArray:
        """Return the residuals (channel, n) of some lines of one segment, filled, times vectors (n, k)."""
        gaps, live, number = ~self._whole[lines], self.a > 0.0, self.segment[lines[0]]
        made = mixed_whole(self.value, live, lines, gaps, vectors) / self.divisor[:, number][:, None]
        made -= self.basis @ (filled.z[:, lines[~gaps]] @ vectors[~gaps])
        for part in blocks(len(made), int(np.sum(gaps))):
            some = np.flatnonzero(gaps)[part]
            made += self.residual(filled, lines[some]) @ vectors[some]
        if not np.all(live):
            made[~live] = filled.residual(lines, ~live) @ vectors
        return np.asarray(made)

    @cached_property
    def _whole(self) -> Held:
        """Lines (line,) at which no channel in use is missing; none of a short measurement."""
        if self.value.size < _SHORT:
            return np.zeros(len(self.line), dtype=bool)
        live = self.a > 0.0
        here = self.held if np.all(live) else self.held[live]
        return np.asarray(np.count_nonzero(here, axis=0) == len(here))

    @property
    def _split(self) -> tuple[NDArray[np.intp], list[tuple[int, NDArray[np.intp]]]]:
        """Lines that are packed and have gaps, and all that are packed, by segment, where some have none."""
        gaps = ~self._whole[self.good]
        if np.all(gaps):
            return self.good, []
        edges = np.searchsorted(self.segment[self.good], np.arange(self.divisor.shape[1] + 1))
        parts = [(n, self.good[a:b]) for n, (a, b) in enumerate(pairwise(edges)) if b > a]
        return self.good[gaps], parts

    def _values(self, lines: NDArray[np.intp]) -> ComplexArray:
        """Return the readings (channel, n) of some lines, zero where missing."""
        place = np.where(self.held[:, lines], self.value[:, lines], 0.0)
        place *= self._inverse[:, self.segment[lines]]
        return np.asarray(place)

    @cached_property
    def _inverse(self) -> ComplexArray:
        return np.asarray(1.0 / self.divisor)

    def _weights(self, lines: NDArray[np.intp]) -> Array:
        return np.asarray(self.held[:, lines] * (self.a[:, None] * self.line[lines]) ** 2)

    def _residual(self, lines: NDArray[np.intp], z: ComplexArray) -> ComplexArray:
        return np.asarray(np.where(self.held[:, lines], self._values(lines) - self.basis @ z, 0.0))

    def _given(self) -> tuple[ComplexArray, Array]:
        """Return the motion (m, line) with the rows as given, and the share of noise that residuals keep.

        The share (channel,) is that at lines with gaps, relative to lines without.
        """
        count, size = self.basis.shape
        z = np.zeros((size, self.value.shape[1]), dtype=complex)
        products = (self.basis[:, :, None] * self.basis[:, None]).reshape(count, -1)
        share, number = np.zeros(count), np.zeros(count)
        loose, parts = self._split
        if parts:
            live, own = self.a > 0.0, self.a**2
            common = (own @ products).reshape(size, size)
            once = np.linalg.inv(common + 1e-10 * max(float(np.trace(common)), 1e-300) * np.eye(size))
            back = once @ (self.basis.T * own)
            for segment, lines in parts:
                z[:, lines] = motion_whole(back, self.divisor[:, segment], self.value, live, lines)
            number += live * float(len(self.good) - len(loose))
            share += number * (1.0 - own * (products @ once.ravel()))
        for part in blocks(count, len(loose)):
            lines = loose[part]
            weights = self._weights(lines)
            gram = (weights.T @ products).reshape(-1, size, size)
            trace = np.einsum("fmm->f", gram)
            gram += (1e-10 * np.maximum(trace, 1e-300))[:, None, None] * np.eye(size)
            inverse = np.linalg.inv(gram)
            right = self.basis.T @ (weights * self._values(lines))
            z[:, lines] = np.einsum("fij,jf->if", inverse, right)
            taken = weights * (products @ inverse.reshape(-1, size * size).T)
            share += np.sum(np.where(weights > 0.0, 1.0 - taken, 0.0), axis=1)
            number += np.sum(weights > 0.0, axis=1)
        whole = 1.0 - np.sum(np.linalg.qr(self.a[:, None] * self.basis)[0] ** 2, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            made = share / number / whole
        return z, np.clip(np.where(np.isfinite(made), made, 1.0), _KEPT, 1.0)

    def _loose(self, z: ComplexArray) -> ComplexArray:
        """Return the inverse of a covariance (m, m) well above that of the motion (m, n)."""
        spread = z @ z.conj().T / z.shape[1]
        tiny = 1e-12 * float(np.trace(spread).real) * np.eye(len(z))
        return np.asarray(np.linalg.inv(_LOOSE * spread + tiny), dtype=complex)

    def _large(self, lines: NDArray[np.intp], z: ComplexArray, change: ComplexArray) -> bool:
        """Tell whether the channel that is changed most has a reading of quite another size."""
        weights = self._weights(lines)
        changed = np.sum(weights * np.abs(change @ _varying(z, self.tau[lines])) ** 2, axis=1)
        most = int(np.argmax(changed))
        given = float(weights[most] @ np.abs(self.basis[most] @ z) ** 2)
        return bool(changed[most] > _ANOTHER**2 * given)

    def _together(
        self, pick: NDArray[np.intp], change: ComplexArray, before: float, loose: ComplexArray
    ) -> tuple[ComplexArray, float]:
        """Return the change of the rows that fits some lines best with their motion, and the misfit left.

        Notes
        -----
        Low-rank approximation of a matrix with gaps by criss-cross regression (Gabriel and Zamir 1979,
        doi:10.1080/00401706.1979.10489819), started and weakly held at the rows as given.
        """
        for _ in range(_ROUNDS):
            z = self._solved(pick, change, loose)
            change, left, _ = self._regressed(pick, z)
            if before - left < _SETTLED * left:
                break
            before = left
        return change, left

    def _regressed(self, lines: NDArray[np.intp], z: ComplexArray) -> tuple[ComplexArray, float, bool]:
        """Return the change of the rows that residuals show, the misfit left, and whether it is clear."""
        from scipy.special import fdtrc

        weights, residual = self._weights(lines), self._residual(lines, z)
        number, energy = np.sum(weights > 0.0, axis=1), np.sum(weights * np.abs(residual) ** 2, axis=1)
        both = _varying(z, self.tau[lines])
        right = (weights * residual) @ both.conj().T
        gram = _grams(weights, both)
        size = np.maximum(np.max(np.abs(self.basis), axis=1), 1e-12)
        gram = gram + (_WIDTH * size)[:, None, None] ** -2 * np.eye(len(both))
        change = np.zeros(right.shape, dtype=complex)
        clear = False
        for channel in np.flatnonzero(number > _LINES * len(z)):
            width = len(both) if number[channel] > 2 * _LINES * len(z) else len(z)
            found = np.linalg.solve(gram[channel, :width, :width].T, right[channel, :width])
            left = float(weights[channel] @ np.abs(residual[channel] - found @ both[:width]) ** 2)
            free = 2.0 * (number[channel] - width)
            ratio = max(energy[channel] - left, 0.0) / (2.0 * width) / max(left / free, 1e-300)
            clear = clear or bool(fdtrc(2.0 * width, free, ratio) < _CLEAR)
            change[channel, :width], energy[channel] = found, left
        return change, float(np.sum(energy)), clear

    def _solved(self, lines: NDArray[np.intp], change: ComplexArray, loose: ComplexArray) -> ComplexArray:
        """Return the motion (m, n) at some lines, with changed rows."""
        size = self.basis.shape[1]
        root = np.sqrt(self._weights(lines)).T
        rows = self.basis + change[:, :size] + self.tau[lines][:, None, None] * change[:, size:]
        white = root[:, :, None] * rows
        turned = white.conj().transpose(0, 2, 1)
        right = turned @ (root * self._values(lines).T)[:, :, None]
        return np.asarray(np.linalg.solve(turned @ white + loose, right)[:, :, 0].T)

    def _motion(
        self, given: ComplexArray, change: ComplexArray, loose: ComplexArray
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the motion (m, line) of the filled readings with the rows as given, and with those found."""
        z, found = given.copy(), given.copy()
        back = np.linalg.pinv(self.a[:, None] * self.basis) * self.a
        for part in blocks(len(self.a) * len(z), len(self.good)):
            lines = self.good[part]
            moved = self._solved(lines, change, loose)
            made = self.basis @ moved + change @ _varying(moved, self.tau[lines])
            found[:, lines] = moved
            z[:, lines] = back @ np.where(self.held[:, lines], self._values(lines), made)
        return z, found

    def _settled(self, z: ComplexArray) -> tuple[ComplexArray, Array]:
        """Return the change of the rows with which gaps are filled, and the share of what is known of it.

        Notes
        -----
        A channel's readings tell its change along some directions of the motion as well as if none was
        missing, along others less. The noise of the filled readings is to be the same along all; the change
        is brought to that, by not more than a few of its standard deviations, so that large faults stay what
        they are.
        """
        count, size = self.basis.shape
        gram = np.zeros((count, 2 * size, 2 * size), dtype=complex)
        right = np.zeros((count, 2 * size), dtype=complex)
        whole = np.zeros((2 * size, 2 * size), dtype=complex)
        loose, parts = self._split
        for segment, lines in parts:
            both, gaps = _varying(z[:, lines], self.tau[lines]), ~self._whole[lines]
            vectors = (np.where(gaps, 0.0, self.line[lines] ** 2) * both).conj().T
            seen = mixed_whole(self.value, self.a > 0.0, lines, gaps, vectors)
            right += seen / self.divisor[:, segment][:, None] - self.basis @ (z[:, lines] @ vectors)
            whole += both @ vectors
        gram += whole.conj().T
        for part in blocks(count, len(loose)):
            lines = loose[part]
            both = _varying(z[:, lines], self.tau[lines])
            weights = self.held[:, lines] * self.line[lines] ** 2
            gram += _grams(weights, both)
            right += (weights * self._residual(lines, z[:, lines])) @ both.conj().T
            whole += (self.line[lines] ** 2 * both) @ both.conj().T
        change, share = np.zeros_like(right), np.ones(count)
        some = np.flatnonzero((self.a > 0.0) & ~np.all(self.held[:, self.good], axis=1))
        wide = shares_of(whole, gram[some])
        narrow = shares_of(whole[:size, :size], gram[some, :size, :size])
        for number, channel in enumerate(some):
            known = [(shares[number], turn[number]) for shares, turn in (wide, narrow)]
            sd = np.sqrt(2.0) / self.a[channel]
            change[channel], share[channel] = brought(known, right[channel], sd)
        return change, share


@dataclass(frozen=True)
class FilledLines:
    """A run of lines (n,) of one segment, filled where readings are missing."""

    gaps: Gaps
    filled: Filled
    lines: NDArray[np.intp]

    @property
    def z(self) -> ComplexArray:
        """Motion (m, n)."""
        return np.asarray(self.filled.z[:, self.lines])

    def mixed(self, vectors: ComplexArray) -> ComplexArray:
        """Return the residuals times vectors (n, k)."""
        return self.gaps.mixed(self.filled, self.lines, vectors)

    def at(self, pick: NDArray[np.intp]) -> ComplexArray:
        """Return the residuals (channel, k) of some of the lines."""
        return self.gaps.residual(self.filled, self.lines[pick])


def _grams(weights: Array, both: ComplexArray) -> NDArray[Any]:
    """Return sums of z z^H over the lines with the weights of each channel, (channel, n, n)."""
    size = len(both)
    products = (both[:, None] * both.conj()[None]).reshape(size * size, -1).T.copy()
    made = weights @ products.view(float)
    return np.asarray(made.view(complex).reshape(len(weights), size, size))
