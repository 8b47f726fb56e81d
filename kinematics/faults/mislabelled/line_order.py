"""Lines of a body that were sorted as text: "1000, 10000, 200"."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.adaptation import CORRECTED, Correction
from kinematics.faults.findings import Finding
from kinematics.faults.mislabelled.exchanged_bodies import joins_better, ligament_misfit
from kinematics.measurement import Measurement
from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.motion import RigidMotion
from stapeskit.records.motion_files import standard_deviation
from stapeskit.warnings import Notice

Order = NDArray[np.intp]
# Probability of steps so much smaller by chance, for each body and run.
_CHANCE = 1e-4
# Fewest lines, and power in units of the noise of a component that counts half.
_LEAST, _NOISY = 8, 40.0


def text_orders(freq_hz: Array) -> Iterator[tuple[Order, str]]:
    """Yield from where the readings of each line are to be taken, and what was sorted as text.

    Either the column of frequencies was, beside values in the order of numbers, or the values were (files by
    their names) beside a column in the order of numbers.
    """
    words = [f"{value:.12g}" for value in freq_hz]
    order = np.array(sorted(range(len(words)), key=words.__getitem__), dtype=np.intp)
    if np.array_equal(order, np.arange(len(words))):
        return
    yield order, "the column freq_hz"
    back = np.argsort(order)
    if not np.array_equal(back, order):
        yield back, "the values"


def rate_ratio(order: Order, freq_hz: Array, derivatives: int) -> Array:
    """Return what displacements are multiplied by when their readings come to other lines (line,)."""
    return np.asarray((freq_hz[order] / freq_hz) ** derivatives)


@dataclass(frozen=True)
class Sorted:
    """A body whose lines are sorted as text.

    Attributes
    ----------
    run, body : int
    lines : ndarray, (freq,), int
        From which line the readings of each line are to be taken.
    what, because : str
        What was sorted, and what shows it.
    """

    run: int
    body: int
    lines: Order
    what: str
    because: str = "the motion jumps from line to line and is smooth in the other order"

    def notice(self, motion: RigidMotion) -> Notice:
        """Return the warning, by the names of the files."""
        where = f" in run {motion.runs[self.run]}" if len(motion.runs) > 1 else ""
        words = ", ".join(sorted(f"{value:.12g}" for value in motion.freq_hz)[:3])
        return Notice(
            "label_swap",
            f"{self.what} of {motion.bodies[self.body]}{where} look sorted as text ({words}, ...) and not as "
            f"numbers: {self.because}. Sort both columns together.",
        )

    def correction(self, placed: Measurement) -> Correction:
        """Return what puts the readings at their frequencies; an order has no uncertainty."""
        channels = list(range(len(placed.bodies[self.body].points)))
        text = f"{self.what} sorted as text; lines put in the order of their numbers"
        finding = Finding("label_swap", channels, 0.0, text=text)
        ratio = rate_ratio(self.lines, placed.freq_hz, placed.order)
        factor: ComplexArray = np.asarray(1.0 / ratio[None], dtype=complex)
        return Correction(
            self.run,
            self.body,
            channels,
            CORRECTED,
            "label_swap",
            text,
            finding,
            factor=factor,
            lines=self.lines,
        )

    def undone(self, motion: RigidMotion, derivatives: int) -> RigidMotion:
        """Return a motion with the lines of this body in their order."""
        q, covariance = motion.q.copy(), motion.covariance.copy()
        ratio, own = rate_ratio(self.lines, motion.freq_hz, derivatives), (self.run, self.body)
        q[own] = q[own][self.lines] * ratio[:, None]
        covariance[own] = covariance[own][self.lines] * (ratio**2)[:, None, None]
        return replace(motion, q=q, covariance=covariance)


def sorted_bodies(
    motion: RigidMotion, derivatives: int, structure: str = "stapes", base: str = "base"
) -> list[Sorted]:
    """Return the bodies whose lines stand in the order of text.

    Parameters
    ----------
    motion : RigidMotion
    derivatives : int
        Time derivatives in what was measured.
    structure, base : str
        Bodies that one ligament joins.
    """
    found = []
    sd, orders = standard_deviation(motion), list(text_orders(motion.freq_hz))
    for run, body in product(range(len(motion.runs)), range(len(motion.bodies))):
        told = _text_order(motion, sd, orders, (run, body), derivatives)
        if told is not None:
            found.append(Sorted(run, body, *told))
    if not found and orders and {structure, base} <= set(motion.bodies):
        return _by_ligament(motion, orders, derivatives, (structure, base))
    return found


def _by_ligament(
    motion: RigidMotion, orders: list[tuple[Order, str]], derivatives: int, pair: tuple[str, str]
) -> list[Sorted]:
    """Return the bodies, all runs alike, that one ligament joins in the order of text and not as given.

    That takes no smooth course: lines may be few or far apart.
    """
    given = ligament_misfit(motion, *pair)
    if given is None:
        return []
    one, two = (motion.bodies.index(name) for name in pair)
    best, found = given, list[Sorted]()
    because = "no ligament joins the two bodies with the lines as they stand, and one does in the other order"
    for (lines, what), bodies in product(orders, ((one,), (two,), (one, two))):
        tried = [
            Sorted(run, body, lines, what, because) for run, body in product(range(len(motion.runs)), bodies)
        ]
        right = motion
        for one_sorted in tried:
            right = one_sorted.undone(right, derivatives)
        misfit = ligament_misfit(right, *pair)
        if misfit is not None and misfit < best and joins_better(given, misfit):
            best, found = misfit, tried
    return found


def measured_order(order: Order, good: NDArray[np.bool_]) -> Order:
    """Return an order of the lines that were measured as one of all lines, the others where they are."""
    whole = np.arange(len(good))
    places = np.flatnonzero(good)
    whole[places] = places[order]
    return whole


def _text_order(
    motion: RigidMotion, sd: Array, orders: list[tuple[Order, str]], own: tuple[int, int], derivatives: int
) -> tuple[Order, str] | None:
    """Return the order in which the motion of a body runs smoothly, when it is that of text; None otherwise.

    Notes
    -----
    The course of a motion is smooth over frequency where lines are dense. Neighbours in one order that are
    none in the other tell them apart: |step|^2 over the squares of its ends, 0 to 2, in units of the noise,
    is averaged over those of each order, and the ratio of the two compared with that of two sums of as
    many squares (F distribution). Where noise or few lines leave no course, both are alike.
    """
    from scipy.special import fdtrc

    q, sd = motion.q[own], sd[own]
    good = np.all(np.isfinite(q) & np.isfinite(sd) & (sd > 0.0), axis=1)
    if int(np.sum(good)) < _LEAST:
        return None
    freq = motion.freq_hz[good]
    rate = freq[:, None] ** derivatives
    best, found = _CHANCE, None
    for order, what in orders if np.all(good) else text_orders(freq):
        ratio, number = steps_ratio(q[good] * rate, sd[good] * rate, order)
        chance = float(fdtrc(number, number, ratio))
        if chance < best:
            best, found = chance, (measured_order(order, good), what)
    return found


def steps_ratio(readings: ComplexArray, sd: Array, order: Order) -> tuple[float, int]:
    """Return the steps of readings (line, m) over those in another order, and how many are compared."""
    white = readings / np.sqrt(np.mean(sd**2, axis=0))
    given, other = _neighbours(np.arange(len(order))), _neighbours(order)
    here, there = np.setdiff1d(given, other), np.setdiff1d(other, given)
    return _step(white, here) / max(_step(white, there), 1e-300), len(here)


def _neighbours(order: Order) -> Order:
    """Return each two neighbours as one number: the lower line times the number of lines, and the other."""
    ends = np.sort(np.stack([order[:-1], order[1:]]), axis=0)
    return np.asarray(ends[0] * len(order) + ends[1])


def _step(white: ComplexArray, pairs: Order) -> float:
    """Return the mean of |step|^2 over the squares of its ends, where these are well above noise."""
    one, two = white[pairs // len(white)], white[pairs % len(white)]
    size = np.sum(np.abs(one) ** 2 + np.abs(two) ** 2, axis=1)
    weight = size / (size + _NOISY * white.shape[1])
    step = np.sum(np.abs(one - two) ** 2, axis=1) / np.maximum(size, 1e-300)
    return float(np.sum(weight * step) / np.maximum(np.sum(weight), 1e-300))
