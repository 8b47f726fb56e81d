"""Lines of a body in a wrong order: sorted as text, "1000, 10000, 200", or two of them exchanged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from legacy.kinematics.faults.adaptation import CORRECTED, Correction
from legacy.kinematics.faults.alternatives import Proposal, proposed
from legacy.kinematics.faults.findings import Finding
from legacy.kinematics.faults.proposals.two_bodies import Order, Pair, joins_better
from legacy.kinematics.measurement import Measurement
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.records.motion_files import standard_deviation
from legacy.stapeskit.warnings import Notice

# Probability of steps so much smaller by chance, for each body and run.
_CHANCE = 1e-4
# Fewest lines, and power in units of the noise of a component that counts half.
_LEAST, _NOISY = 8, 40.0
_SMOOTH = "the motion jumps from line to line and is smooth in the other order"
_JOINED = "no ligament joins the two bodies with the lines as they stand, and one does in the other order"


def rate_ratio(order: Order, freq_hz: Array, derivatives: int) -> Array:
    """Return what displacements are multiplied by when their readings come to other lines (line,)."""
    return np.asarray((freq_hz[order] / freq_hz) ** derivatives)


@dataclass(frozen=True)
class Reordered:
    """A body whose lines are in a wrong order.

    Attributes
    ----------
    lines : ndarray, (freq,), int
        From which line the readings of each line are to be taken.
    estimate : str
        What is wrong, in words.
    sentence : str
        Of the warning, with {bodies}.
    """

    run: int
    body: int
    lines: Order
    estimate: str
    sentence: str

    @classmethod
    def of(cls, run: int, body: int, lines: Order, order: Proposal, **words: str) -> Reordered:
        """Return a body in an order that was proposed."""
        said = {**order.words, **words, "bodies": "{bodies}"}
        estimate, sentence = order.entry.estimate.format(**said), order.entry.sentence.format(**said)
        return cls(run, body, lines, estimate, sentence)

    def correction(self, placed: Measurement) -> Correction:
        """Return what puts the readings at their frequencies; an order has no uncertainty."""
        body, ratio = placed.bodies[self.body], rate_ratio(self.lines, placed.freq_hz, placed.order)
        sd = None if body.sd is None else body.sd[self.run][:, self.lines] * ratio
        right = body.with_run(self.run, body.displacement[self.run][:, self.lines] * ratio, sd)
        channels = list(range(len(body.points)))
        finding = Finding("label_swap", channels, 0.0, text=self.estimate, remedied=right)
        return Correction(self.run, self.body, channels, CORRECTED, finding.kind, self.estimate, finding)


def put_in_order(motion: RigidMotion, reordered: Sequence[Reordered], derivatives: int) -> RigidMotion:
    """Return a motion with the lines of some bodies in their order."""
    if not reordered:
        return motion
    q, covariance = motion.q.copy(), motion.covariance.copy()
    for body in reordered:
        ratio, own = rate_ratio(body.lines, motion.freq_hz, derivatives), (body.run, body.body)
        q[own] = q[own][body.lines] * ratio[:, None]
        covariance[own] = covariance[own][body.lines] * (ratio**2)[:, None, None]
    return replace(motion, q=q, covariance=covariance)


def order_notices(motion: RigidMotion, reordered: Sequence[Reordered]) -> list[Notice]:
    """Return one warning for all bodies and runs with the same lines in a wrong order."""
    bodies_of: dict[str, list[str]] = {}
    for body in reordered:
        where = f" in run {motion.runs[body.run]}" if len(motion.runs) > 1 else ""
        bodies_of.setdefault(body.sentence, []).append(f"{motion.bodies[body.body]}{where}")
    return [
        Notice("label_swap", sentence.format(bodies=" and of ".join(bodies)))
        for sentence, bodies in bodies_of.items()
    ]


def reordered_bodies(
    motion: RigidMotion, derivatives: int, structure: str = "stapes", base: str = "base"
) -> list[Reordered]:
    """Return the bodies whose lines are in a wrong order: those sorted as text come first.

    ``derivatives`` as of ``Pair.of``: the readings are what has another order.

    Notes
    -----
    Lines far apart, where chance may make an exchange of two smooth, are not believed to be exchanged when
    one ligament explains both bodies better as they are.
    """
    rate = motion.freq_hz[:, None] ** derivatives
    orders = list(proposed("lines", motion.freq_hz))
    reordered = _by_course(motion, rate, orders)
    right = put_in_order(motion, reordered, derivatives)
    exchanged = _by_jumps(right, rate)
    if exchanged:
        again = put_in_order(right, exchanged, derivatives)
        pairs = [Pair.of(one, structure, base, derivatives=derivatives) for one in (right, again)]
        misfits = [misfit for pair in pairs if pair is not None and (misfit := pair.misfit()) is not None]
        if len(misfits) < 2 or misfits[1] <= misfits[0]:
            reordered += exchanged
    return reordered or _by_ligament(motion, derivatives, orders, (structure, base))


def _by_course(motion: RigidMotion, rate: Array, orders: list[Proposal]) -> list[Reordered]:
    """Return the bodies whose motion runs smoothly in the order of text, and not as given.

    Notes
    -----
    The course of a motion is smooth over frequency where lines are dense. Neighbours in one order that are
    none in the other tell them apart: |step|^2 over the squares of its ends, 0 to 2, in units of the noise,
    is averaged over those of each order, and the ratio of the two compared with that of two sums of as
    many squares (F distribution). Where noise or few lines leave no course, both are alike.
    """
    from scipy.special import fdtrc

    reordered = []
    sd = standard_deviation(motion) if orders else np.zeros(0)
    for run, body in product(range(len(motion.runs)), range(len(motion.bodies))) if orders else ():
        readings, noise = motion.q[run, body] * rate, sd[run, body] * rate
        good = np.all(np.isfinite(readings) & np.isfinite(noise) & (noise > 0.0), axis=1)
        if int(np.sum(good)) < _LEAST:
            continue
        least, likeliest = _CHANCE, None
        for order in orders if np.all(good) else proposed("lines", motion.freq_hz[good]):
            ratio, number = steps_ratio(readings[good], noise[good], order.value)
            chance = float(fdtrc(number, number, ratio))
            if chance < least:
                lines, places = np.arange(len(good)), np.flatnonzero(good)
                lines[places] = places[order.value]
                least, likeliest = chance, Reordered.of(run, body, lines, order, because=_SMOOTH)
        reordered += [] if likeliest is None else [likeliest]
    return reordered


def _by_ligament(
    motion: RigidMotion, derivatives: int, orders: list[Proposal], names: tuple[str, str]
) -> list[Reordered]:
    """Return the bodies, all runs alike, that one ligament joins in the order of text and not as given.

    That takes no smooth course: lines may be few or far apart. Readings are compared, which have the same
    size in any order.
    """
    pair = Pair.of(motion, *names, derivatives=derivatives) if orders else None
    if pair is None:
        return []
    as_given = pair.misfit()
    if as_given is None:
        return []
    least, reordered = as_given, list[Reordered]()
    for order, bodies in product(orders, ((0,), (1,), (0, 1))):
        misfit = pair.lines(*(order.value if body in bodies else slice(None) for body in (0, 1))).misfit()
        if misfit is not None and misfit < least and joins_better(as_given, misfit):
            least = misfit
            reordered = [
                Reordered.of(run, motion.bodies.index(names[body]), order.value, order, because=_JOINED)
                for run, body in product(range(len(motion.runs)), bodies)
            ]
    return reordered


def _by_jumps(motion: RigidMotion, rate: Array) -> list[Reordered]:
    """Return the bodies whose motion is smooth only when two lines are exchanged."""
    sd = standard_deviation(motion)
    return [
        Reordered.of(run, body, order.value, order)
        for run, body in product(range(len(motion.runs)), range(len(motion.bodies)))
        for order in proposed("course", (motion.q[run, body] * rate, sd[run, body] * rate, motion.freq_hz))
    ]


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
    lower, upper = white[pairs // len(white)], white[pairs % len(white)]
    size = np.sum(np.abs(lower) ** 2 + np.abs(upper) ** 2, axis=1)
    weight = size / (size + _NOISY * white.shape[1])
    step = np.sum(np.abs(lower - upper) ** 2, axis=1) / np.maximum(size, 1e-300)
    return float(np.sum(weight * step) / np.maximum(np.sum(weight), 1e-300))
