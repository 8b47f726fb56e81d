"""One of two bodies in rms, or in another range or unit: a few lines at low frequencies show it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product

import numpy as np

from kinematics.faults.mislabelled.relative_scale import log_evidence, unrelated_evidence
from kinematics.faults.mislabelled.two_bodies import Pair
from stapeskit.warnings import Notice

# Log likelihood that another size must gain, besides the logarithm of the number of those tried: odds of
# 20 000. What it must gain over motions that no ligament joins: odds of 150. What a size that is no ratio of
# ranges may gain over it: odds of 20.
_MARGIN, _BEYOND, _BESIDE = 10.0, 5.0, 3.0
# Ratios of rms and peak values, and of the ranges of vibrometers, in steps of 1, 2, 5.
_RMS = (2.0**0.5, 0.5**0.5)
_RANGES = tuple(x for r in (2.0, 2.5, 4.0, 5.0, 10.0) for x in (r, 1.0 / r))
# Sizes that compete with these: none, any, and the opposite sign.
_COMPETING = (0.0, -1.0, *np.geomspace(0.08, 12.5, 41))
# The factor of the base in each run, and what the sentence says of it.
Size = tuple[tuple[float, ...], dict[str, object]]


def _rms(pair: Pair) -> Iterator[Size]:
    structure, base = pair.names
    for factor, rms, peak in zip(_RMS, (base, structure), (structure, base), strict=True):
        yield (factor,) * len(pair.runs), {"rms": rms, "peak": peak}


def _range(pair: Pair) -> Iterator[Size]:
    for factor in _RANGES:
        yield (factor,) * len(pair.runs), {}


def _range_of_a_run(pair: Pair) -> Iterator[Size]:
    for run, factor in product(pair.runs if len(pair.runs) > 1 else (), (*_RMS, *_RANGES)):
        yield tuple(factor if run == own else 1.0 for own in pair.runs), {"run": run}


# Each with what its sentence says.
SIZES: tuple[tuple[Callable[[Pair], Iterator[Size]], str], ...] = (
    (
        _rms,
        ": {rms} looks given in rms and {peak} in peak values. Name the columns of {rms} amp_rms or give all "
        "in peak values.",
    ),
    (
        _range,
        ": one of the two bodies looks measured in another range or unit. Check the ranges of the "
        "vibrometer, and correct the values of that body.",
    ),
    (
        _range_of_a_run,
        " in run {run} alone: one of the two bodies looks measured in another range or unit there. Check the "
        "ranges of the vibrometer, and correct the values of that body in run {run}.",
    ),
)


def size_notices(pair: Pair) -> list[Notice]:
    """Warn when the readings of a body have another size than a ligament could make, and say which.

    Notes
    -----
    A size is believed that the data make likelier than that as given, than any other size by much, and than
    no ligament: motions that have nothing to do with each other, or by any constant matrix.
    """
    if not len(pair.complete_lines()) or not np.isfinite(log_evidence(pair)):
        return []
    sizes = [(*size, sentence) for kind, sentence in SIZES for size in kind(pair)]
    evidence = [log_evidence(_times(pair, factors)) for factors, _details, _sentence in sizes]
    best = int(np.argmax(evidence))
    factors, details, sentence = sizes[best]
    likeliest, gain = _times(pair, factors), evidence[best] - log_evidence(pair)
    if not gain >= _MARGIN + np.log(len(sizes)):
        return []
    if evidence[best] < _BEYOND + max(unrelated_evidence(pair), log_evidence(likeliest, related=False)):
        return []
    own = np.array(factors) != 1.0
    others = [_times(pair, tuple(np.where(own, factor, 1.0))) for factor in _COMPETING]
    if max(log_evidence(other) for other in [*others, _conjugate(pair)]) > evidence[best] + _BESIDE:
        return []
    structure, base = pair.names
    number = f"{next(factor for factor in factors if factor != 1.0):.4g}"
    alike = [
        f"{next(factor for factor in other if factor != 1.0):.4g}"
        for k, (other, _details, _sentence) in enumerate(sizes)
        if k != best and evidence[k] > evidence[best] - _BESIDE
    ]
    text = (
        f"no ligament joins {structure} and {base} as they are labelled, but one would (log likelihood ratio "
        f"{gain:.0f}) with {base} {' or '.join([number, *alike])} times as large"
    ) + sentence.format(**details)
    return [Notice("unit_slip", text)]


def rms_would_show(pair: Pair) -> bool:
    """Return whether either body would be found in rms while the other is in peak values."""
    return all(size_notices(_times(pair, factors)) for factors, _details in _rms(pair))


def _times(pair: Pair, factors: tuple[float, ...]) -> Pair:
    """Return a pair with the motion of the base times a factor for each run."""
    factor = np.array(factors)[:, None, None]
    sd = np.stack([pair.sd[:, 0], pair.sd[:, 1] * np.abs(factor)], axis=1)
    return replace(pair, base=pair.base * factor, sd=sd)


def _conjugate(pair: Pair) -> Pair:
    return replace(pair, base=pair.base.conj())
