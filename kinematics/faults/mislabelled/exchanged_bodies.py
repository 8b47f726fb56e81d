"""Whole bodies, runs or frequency columns under a wrong label, identified by the ligament between two bodies.

Each body by itself moves rigidly then, and no residual shows anything. What is left is that one and the same
ligament carries the stapes in every run and at every line.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from stapeskit.arrays import Array, ComplexArray
from stapeskit.records.motion import RigidMotion
from stapeskit.records.motion_files import standard_deviation

# Share of the motion that one ligament of constant matrices leaves even of right data.
_MODEL = 0.02
# Misfits, 1 of right labels: others are tried above _BAD, and taken below _GOOD and _BETTER of the given.
_BETTER, _GOOD, _BAD = 0.2, 2.0, 5.0
# The same for amplitudes of one body in rms or another range: factors that are known leave less to chance.
_LESS, _SLIP = 0.4, 2.0
# Ratios of the ranges of vibrometers, in steps of 1, 2, 5; and of rms and peak values.
_RANGES = tuple(x for r in (2.0**0.5, 2.0, 2.5, 4.0, 5.0, 10.0) for x in (r, 1.0 / r))
# Real values of a component beyond its unknowns in A, B and C. With 11 a wrong label is taken in 0.2 % of
# 1200 motions that no ligament makes and in none of 800 right ones, with 7 in 0.5 %, with 3 in 2.7 %.
_SPARE = 11
# Power over that of noise from which a motion counts as one.
_SEEN = 4.0
# Runs of which all orders are tried, the largest shift in lines, and lines looked at: they bound the time.
_MOST_RUNS, _REACH, _LINES = 4, 5, 200


@dataclass(frozen=True)
class Label:
    """One way in which the labels of two bodies could be wrong.

    Attributes
    ----------
    kind : str
        ``right``, ``conjugate`` (one body), ``sign`` (one body), ``bodies`` (exchanged), ``amplitude`` (one
        body in rms, the other in peak values), ``range`` (of one body in one run of several), ``runs`` (of
        one body exchanged) or ``frequency`` (of one body shifted).
    order : tuple of int
        For ``runs``: which run of the base belongs to each run of the structure. For ``range``: the run.
    shift : int
        For ``frequency``: at which line later the rows of the base belong.
    factor : float
        For ``amplitude``, ``range`` and ``conjugate``: by what the rows of the base are to be multiplied.
        Conjugates of velocities are those of displacements with the opposite sign.
    """

    kind: str
    order: tuple[int, ...] = ()
    shift: int = 0
    factor: float = 1.0


@dataclass(frozen=True)
class Ligament:
    """How well one ligament explains the motion of two bodies, labelled in different ways.

    Attributes
    ----------
    best : Label
        ``right`` unless another explains what that does not.
    misfit : dict of Label to float
        Mean squared misfit in units of noise and of 2 % of the motion; of few labels when the given ones
        leave little.
    """

    best: Label
    misfit: dict[Label, float]

    def rather(self, kind: str, share: float) -> bool:
        """Return whether a label leaves less than a share of what the given ones leave."""
        return self.misfit[Label(kind)] < share * self.right

    @property
    def right(self) -> float:
        """Misfit of the labels as given."""
        return self.misfit[Label("right")]


def ligament_test(motion: RigidMotion, structure: str, base: str) -> Ligament | None:
    """Compare ways to label two bodies; None with too few lines or without both bodies.

    Notes
    -----
    With w^2 M q_s = (K (1 + i eta) + i w D) dq every component of dq = q_s - q_b is
    dq = w^2 A q_s - i w B dq - i C dq with the same real A, B and C at all lines and in all runs: a linear
    regression that needs no mass matrix; solved for q_s it is another, which noise spoils less when the
    ligament is soft. The better of both counts for each component. It holds for data that are both conjugated
    as well, with the opposite damping. Misfits count in units of the noise and of 2 % of the motion. Another
    label is taken when it explains the data to twice that, and leaves a fifth of what the given ones leave.
    """
    data = _pair(motion, structure, base)
    if data is None:
        return None
    misfit = {label: data.misfit(label) for label in _whole()}
    given = misfit[Label("right")]
    if given > _BAD:
        misfit |= {label: data.misfit(label) for label in _labels(*data.structure.shape[:2])}
    best = _best(misfit)
    if (
        given > _SLIP and best.kind == "right"
    ):  # of many factors one fits by chance what another label explains
        misfit |= {label: data.misfit(label) for label in _ranges(len(data.structure))}
        best = _best(misfit)
    return Ligament(best, misfit)


def _best(misfit: dict[Label, float]) -> Label:
    """Return the label that explains what those given do not, or ``right``."""
    right = Label("right")
    best = min(misfit, key=lambda label: misfit[label])
    if best.kind in ("amplitude", "range"):
        taken = misfit[right] > _SLIP and misfit[best] < min(_GOOD, _LESS * misfit[right])
    else:
        taken = joins_better(misfit[right], misfit[best])
    return best if taken else right


def ligament_misfit(motion: RigidMotion, structure: str, base: str) -> float | None:
    """Return the misfit of one ligament to two bodies as they are labelled; None as of `ligament_test`."""
    data = _pair(motion, structure, base)
    return None if data is None else data.misfit(Label("right"))


def joins_better(given: float, other: float) -> bool:
    """Return whether a ligament that explains little of the data as given explains them in another way."""
    return given > _BAD and other < min(_GOOD, _BETTER * given)


def _pair(motion: RigidMotion, structure: str, base: str) -> _Pair | None:
    """Return the motion of two bodies where both were measured; None with too few lines."""
    if structure not in motion.bodies or base not in motion.bodies:
        return None
    one, two = motion.bodies.index(structure), motion.bodies.index(base)
    good = np.all(np.isfinite(motion.q[:, [one, two]].real), axis=(0, 1, 3))
    lines = np.flatnonzero(good)
    if len(lines) > _LINES:
        start = (len(lines) - _LINES) // 2
        step = len(lines) // _LINES
        lines = lines[start % step :: step]
    runs, size = len(motion.runs), len(motion.dof)
    if 2 * runs * len(lines) < 3 * size + _SPARE:
        return None
    sd = standard_deviation(motion)[:, [one, two]][:, :, lines]
    if not np.all(np.isfinite(sd)):
        return None
    return _Pair(motion.q[:, one][:, lines], motion.q[:, two][:, lines], sd, motion.freq_hz[lines])


def _whole() -> list[Label]:
    slips = [Label("amplitude", factor=float(np.sqrt(square))) for square in (2.0, 0.5)]
    return [Label("right"), Label("sign"), Label("bodies"), *slips]


def _labels(runs: int, lines: int) -> Iterator[Label]:
    yield from (Label("conjugate", factor=sign) for sign in (1.0, -1.0))
    if runs <= _MOST_RUNS:
        for order in permutations(range(runs)):
            if order != tuple(range(runs)):
                yield Label("runs", order)
    for shift in range(-_REACH, _REACH + 1):
        if shift and lines > 8 * _REACH:
            yield Label("frequency", shift=shift)


def _ranges(runs: int) -> Iterator[Label]:
    for run, factor in product(range(runs if runs > 1 else 0), _RANGES):
        yield Label("range", (run,), factor=factor)


@dataclass(frozen=True)
class _Pair:
    structure: ComplexArray
    base: ComplexArray
    sd: Array
    freq_hz: Array

    def misfit(self, label: Label) -> float:
        """Return the mean squared misfit of one ligament to all runs and lines."""
        s, b, spread = self.structure, self.base, self.sd
        freq = np.broadcast_to(self.freq_hz, s.shape[:2])
        if label.kind == "conjugate":
            b = label.factor * b.conj()
        elif label.kind == "sign":
            b = -b
        elif label.kind == "amplitude":
            b, spread = b * label.factor, spread * np.array([1.0, label.factor])[:, None, None]
        elif label.kind == "range":
            b, spread = b.copy(), spread.copy()
            b[label.order[0]] *= label.factor
            spread[label.order[0], 1] *= label.factor
        elif label.kind == "bodies":
            s, b, spread = b, s, spread[:, ::-1]
        elif label.kind == "runs":
            order = list(label.order)
            b, spread = b[order], np.stack([spread[:, 0], spread[order, 1]], axis=1)
        elif label.kind == "frequency":
            here, there = _overlap(s.shape[1], label.shift)
            s, b, freq = s[:, there], b[:, here], freq[:, there]
            spread = np.stack([spread[:, 0, there], spread[:, 1, here]], axis=1)
        return _misfit(s, b, spread, freq)


def _overlap(lines: int, shift: int) -> tuple[slice, slice]:
    """Return lines and those ``shift`` later."""
    if shift > 0:
        return slice(0, lines - shift), slice(shift, lines)
    return slice(-shift, lines), slice(0, lines + shift)


def _misfit(s: ComplexArray, b: ComplexArray, sd: Array, freq_hz: Array) -> float:
    size = s.shape[-1]
    w = 2.0 * np.pi * freq_hz[..., None]
    dq = s - b
    by_mass = _stacked(w**2 * s, -1j * w * dq, -1j * dq)
    by_spring = _stacked(dq / w**2, 1j * dq / w, 1j * dq / w**2)
    variance = 2.0 * sd**2
    of_dq, of_s = np.sum(variance, axis=1).reshape(-1, size), variance[:, 0].reshape(-1, size)
    moved = np.sqrt(0.5 * np.mean(np.abs(s) ** 2 + np.abs(b) ** 2, axis=(0, 1)))
    own = np.sqrt(np.mean(np.abs(s) ** 2, axis=(0, 1)))
    dq, s = dq.reshape(-1, size), s.reshape(-1, size)
    total = 0.0
    for row in range(size):
        left = _left(by_mass, dq[:, row], of_dq[:, row] + (_MODEL * moved[row]) ** 2)
        # Noise would be explained by nothing as well: a base that hardly moves is no structure.
        if own[row] ** 2 > _SEEN * np.mean(of_s[:, row]):
            left = min(left, _left(by_spring, s[:, row], of_s[:, row] + (_MODEL * own[row]) ** 2))
        total += left
    freedom = dq.size - 1.5 * size * size
    return total / max(freedom, 1.0)


def _stacked(*parts: ComplexArray) -> Array:
    """Return regressors (2 n, k), real parts above imaginary ones, each of unit length."""
    columns = np.concatenate(parts, axis=-1)
    columns = columns.reshape(-1, columns.shape[-1])
    both = np.vstack([columns.real, columns.imag])
    return np.asarray(both / np.maximum(np.linalg.norm(both, axis=0), 1e-300))


def _left(columns: Array, target: ComplexArray, variance: Array) -> float:
    """Return the squared misfit of a regression over the variance (n,) of its complex targets."""
    root = np.tile(1.0 / np.sqrt(variance), 2)
    value = np.concatenate([target.real, target.imag]) * root
    solution = np.linalg.lstsq(columns * root[:, None], value, rcond=1e-10)[0]
    return float(np.sum((value - columns @ solution * root) ** 2))
