"""The ways in which two bodies can be labelled or scaled: each yields the motion under other labels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import permutations, product

import numpy as np

from legacy.kinematics.faults.proposals.two_bodies import Pair

# Runs of which all orders are tried, and the largest shift in lines: they bound the time.
_MOST_RUNS, REACH = 4, 5
# Ratios of rms and peak values, and of the ranges of vibrometers, in steps of 1, 2, 5.
_RMS = (2.0**0.5, 0.5**0.5)
_RANGES = tuple(x for r in (2.0, 2.5, 4.0, 5.0, 10.0) for x in (r, 1.0 / r))
# A motion under other labels, and what the sentence says of them.
Labelled = tuple[Pair, Mapping[str, object]]


def other_sign(pair: Pair) -> Iterator[Labelled]:
    """Yield one body with the opposite sign."""
    yield replace(pair, base=-pair.base), {}


def other_names(pair: Pair) -> Iterator[Labelled]:
    """Yield the two bodies under each other's names."""
    yield replace(pair, structure=pair.base, base=pair.structure, sd=pair.sd[:, ::-1]), {}


def conjugate(pair: Pair) -> Iterator[Labelled]:
    """Yield the conjugate, also with the sign of conjugate velocities, which are i w times displacements."""
    for sign in (1.0, -1.0):
        yield replace(pair, base=sign * pair.base.conj()), {}


def both_conjugate(pair: Pair) -> Iterator[Labelled]:
    """Yield the conjugates of both bodies."""
    yield replace(pair, structure=pair.structure.conj(), base=pair.base.conj()), {}


def other_runs(pair: Pair) -> Iterator[Labelled]:
    """Yield the runs of one body in all other orders."""
    given = range(len(pair.runs))
    for order in permutations(given) if len(given) <= _MOST_RUNS else ():
        if order != tuple(given):
            sd = np.stack([pair.sd[:, 0], pair.sd[list(order), 1]], axis=1)
            exchanged = [f"{pair.runs[order[run]]} as {pair.runs[run]}" for run in given if order[run] != run]
            yield replace(pair, base=pair.base[list(order)], sd=sd), {"exchanged": ", ".join(exchanged)}


def other_lines(pair: Pair) -> Iterator[Labelled]:
    """Yield shifted frequencies of one body."""
    freq, count = pair.freq_hz, len(pair.freq_hz)
    for shift in range(-REACH, REACH + 1) if count > 8 * REACH else ():
        if shift:
            here = slice(max(shift, 0), count + min(shift, 0))
            there = slice(max(-shift, 0), count - max(shift, 0))
            shifted = replace(pair.lines(here, there), freq_hz=freq[here])
            yield shifted, {"hertz": -shift * float(np.median(np.diff(freq))), "lines": abs(shift)}


def rms(pair: Pair) -> Iterator[Labelled]:
    """Yield one body in rms and the other in peak values."""
    structure, base = pair.names
    for factor, of_rms, peak in zip(_RMS, (base, structure), (structure, base), strict=True):
        yield scaled(pair, factor), {"factor": factor, "rms": of_rms, "peak": peak}


def another_range(pair: Pair) -> Iterator[Labelled]:
    """Yield one body in another range."""
    for factor in _RANGES:
        yield scaled(pair, factor), {"factor": factor}


def range_of_a_run(pair: Pair) -> Iterator[Labelled]:
    """Yield one body in another range, or in rms, in one of several runs."""
    for run, factor in product(pair.runs if len(pair.runs) > 1 else (), (*_RMS, *_RANGES)):
        yield scaled(pair, factor, run), {"factor": factor, "run": run}


def scaled(pair: Pair, factor: float, run: object = None) -> Pair:
    """Return a pair with the motion of the base times a factor, in one run or in all."""
    by = np.array([factor if run in (None, own) else 1.0 for own in pair.runs])[:, None, None]
    sd = np.stack([pair.sd[:, 0], pair.sd[:, 1] * np.abs(by)], axis=1)
    return replace(pair, base=pair.base * by, sd=sd)
