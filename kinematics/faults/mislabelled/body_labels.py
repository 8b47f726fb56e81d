"""The ways in which the labels of two bodies can be wrong: one function and one entry of ``KINDS`` each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import permutations, product

import numpy as np

from kinematics.faults.mislabelled.two_bodies import BAD, GOOD, Pair, joins_better
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

# Another factor of one body is tried above the first misfit, and taken below this share of the given: factors
# that are known leave less to chance than other labels do.
_SLIP, _LESS = 2.0, 0.4
# Ratios of the ranges of vibrometers, in steps of 1, 2, 5; and of rms and peak values.
_RANGES = tuple(x for r in (2.0**0.5, 2.0, 2.5, 4.0, 5.0, 10.0) for x in (r, 1.0 / r))
# Runs of which all orders are tried, and the largest shift in lines: they bound the time.
_MOST_RUNS, _REACH = 4, 5
TURN = "check on which side the laser head was, and turn the sign or the directions of one body."
# A motion under other labels, and what the sentence of its kind says of them.
Labelled = tuple[Pair, dict[str, object]]


def _times(pair: Pair, factor: float | Array) -> Pair:
    """Return a pair with the motion of the base times a factor, or one for each run (run, 1, 1)."""
    sd = np.stack([pair.sd[:, 0], pair.sd[:, 1] * np.abs(factor)], axis=1)
    return replace(pair, base=pair.base * factor, sd=sd)


def _other_sign(pair: Pair, _derivatives: int) -> Iterator[Labelled]:
    yield _times(pair, -1.0), {}


def _other_names(pair: Pair, _derivatives: int) -> Iterator[Labelled]:
    yield replace(pair, structure=pair.base, base=pair.structure, sd=pair.sd[:, ::-1]), {}


def _other_amplitude(pair: Pair, _derivatives: int) -> Iterator[Labelled]:
    structure, base = pair.names
    for factor, rms, peak in ((2.0**0.5, base, structure), (0.5**0.5, structure, base)):
        yield _times(pair, factor), {"factor": factor, "rms": rms, "peak": peak}


def _conjugate(pair: Pair, _derivatives: int) -> Iterator[Labelled]:
    """Yield the conjugate, also with the sign of conjugate velocities, which are i w times displacements."""
    for sign in (1.0, -1.0):
        yield replace(pair, base=sign * pair.base.conj()), {}


def _other_runs(pair: Pair, _derivatives: int) -> Iterator[Labelled]:
    given = range(len(pair.runs))
    for order in permutations(given) if len(given) <= _MOST_RUNS else ():
        if order != tuple(given):
            sd = np.stack([pair.sd[:, 0], pair.sd[list(order), 1]], axis=1)
            exchanged = [f"{pair.runs[order[run]]} as {pair.runs[run]}" for run in given if order[run] != run]
            yield replace(pair, base=pair.base[list(order)], sd=sd), {"exchanged": ", ".join(exchanged)}


def _other_lines(pair: Pair, derivatives: int) -> Iterator[Labelled]:
    """Yield the readings, of which displacements are derived, at shifted frequencies."""
    freq, count = pair.freq_hz, len(pair.freq_hz)
    for shift in range(-_REACH, _REACH + 1) if count > 8 * _REACH else ():
        if shift:
            here = slice(max(shift, 0), count + min(shift, 0))
            there = slice(max(-shift, 0), count - max(shift, 0))
            ratio = (freq[there] / freq[here])[:, None] ** derivatives
            shifted = replace(
                pair,
                structure=pair.structure[:, here],
                base=pair.base[:, there] * ratio,
                sd=np.stack([pair.sd[:, 0, here], pair.sd[:, 1, there] * ratio], axis=1),
                freq_hz=freq[here],
            )
            yield shifted, {"hertz": -shift * float(np.median(np.diff(freq))), "lines": abs(shift)}


def _other_range(pair: Pair, _derivatives: int) -> Iterator[Labelled]:
    """Yield one body in one run of several in another range of its vibrometer."""
    count = len(pair.runs)
    for run, factor in product(range(count if count > 1 else 0), _RANGES):
        factors = np.where(np.arange(count) == run, factor, 1.0)[:, None, None]
        yield _times(pair, factors), {"factor": factor, "run": pair.runs[run]}


@dataclass(frozen=True)
class Kind:
    """One way in which labels can be wrong.

    Attributes
    ----------
    labels : function
        Of a pair and the derivatives in what was measured, to the motion under each other label.
    warning : function
        Of a text, to the warning.
    sentence : str
        What the warning says of these labels; with the names of the bodies, and of that which lags less.
    above : float
        Misfit of the labels as given from which on these are tried.
    factor : bool
        The motion is multiplied by a known factor.
    last : bool
        Tried when no other kind explains the data: of many factors one fits by chance.
    """

    labels: Callable[[Pair, int], Iterator[Labelled]]
    warning: Callable[[str], Notice]
    sentence: str
    above: float = 0.0
    factor: bool = False
    last: bool = False


KINDS: dict[str, Kind] = {
    "sign": Kind(
        _other_sign,
        lambda text: Notice("body_sign", text),
        f", but one would with the sign of one of them turned: {TURN}",
    ),
    "bodies": Kind(
        _other_names,
        lambda text: Notice("label_swap", text),
        ": the names {structure} and {base} look exchanged{conjugated}. Exchange them.",
    ),
    "amplitude": Kind(
        _other_amplitude,
        lambda text: Notice("unit_slip", text),
        ", but one would with {base} {factor:.4g} times as large: {rms} looks given in rms and {peak} in "
        "peak values. Name the columns of {rms} amp_rms or give all in peak values.",
        factor=True,
    ),
    "conjugate": Kind(
        _conjugate,
        lambda text: Notice("phase_convention", text),
        ": the data of {leading} alone look like amplitudes of e^{{-iwt}}. Conjugate them (im or phase_deg "
        "with the opposite sign).",
        BAD,
    ),
    "runs": Kind(
        _other_runs,
        lambda text: Notice("label_swap", text),
        ": runs of {base} look exchanged ({exchanged}), or those of {structure} the other way. Correct the "
        "column run.",
        BAD,
    ),
    "frequency": Kind(
        _other_lines,
        lambda text: Notice("label_swap", text),
        ": the frequencies of {base} look shifted against those of {structure} by about {hertz:.3g} Hz "
        "({lines} lines). Check freq_hz.",
        BAD,
    ),
    "range": Kind(
        _other_range,
        lambda text: Notice("unit_slip", text),
        ", but one would with {base} {factor:.4g} times as large in run {run} alone: one of the two bodies "
        "looks measured in another range or unit there. Check the ranges of the vibrometer, and correct the "
        "values of that body in run {run}.",
        _SLIP,
        factor=True,
        last=True,
    ),
}


@dataclass(frozen=True)
class Comparison:
    """How well one ligament explains the motion of two bodies, labelled in different ways.

    Attributes
    ----------
    given, misfit : float
        Misfits of the labels as given and of those that explain most, in units of noise and of 2 % of the
        motion.
    kind : str
        Of the labels that explain most; empty where those as given do.
    pair : Pair
        The motion under these labels.
    details : dict
        What the sentence of the kind says of them.
    least : dict of str to float
        Misfits of the kinds that were tried.
    """

    given: float
    misfit: float
    pair: Pair
    kind: str = ""
    details: dict[str, object] = field(default_factory=dict)
    least: dict[str, float] = field(default_factory=dict)

    @property
    def believed(self) -> bool:
        """Whether other labels explain the data to twice the noise, and what those as given do not.

        They leave a fifth of what those as given leave, or two fifths with a known factor.
        """
        if not self.kind:
            return False
        if KINDS[self.kind].factor:
            return self.given > _SLIP and self.misfit < min(GOOD, _LESS * self.given)
        return joins_better(self.given, self.misfit)

    def rather(self, kind: str, share: float) -> bool:
        """Return whether a kind leaves less than a share of what the labels as given leave."""
        return self.least[kind] < share * self.given

    def notice(self) -> Notice:
        """Return the warning that says which labels explain the data."""
        structure, base = self.pair.names
        lag = self.pair.lag()
        text = (
            f"no ligament joins {structure} and {base} as they are labelled (misfit {self.given:.3g} times "
            f"noise and 2 %, {self.misfit:.2g} otherwise)"
        ) + KINDS[self.kind].sentence.format(
            structure=structure,
            base=base,
            leading=structure if lag is not None and lag.deviations < 0.0 else base,
            conjugated=", and their phases conjugated (e^{-iwt})" if lag is not None and lag.reversed else "",
            **self.details,
        )
        return KINDS[self.kind].warning(text)


def compare_labels(pair: Pair, derivatives: int) -> Comparison | None:
    """Compare ways to label two bodies by the misfit of one ligament; None with too few lines."""
    as_given = pair.misfit()
    if as_given is None:
        return None
    best = Comparison(as_given, as_given, pair)
    for name, kind in KINDS.items():
        if as_given < kind.above or (kind.last and best.believed):
            continue
        for other, details in kind.labels(pair, derivatives):
            misfit = other.misfit()
            if misfit is not None:
                best.least[name] = min(misfit, best.least.get(name, np.inf))
                if misfit < best.misfit:
                    best = replace(best, kind=name, pair=other, details=details, misfit=misfit)
    return best


__all__ = ["KINDS", "TURN", "Comparison", "compare_labels"]
