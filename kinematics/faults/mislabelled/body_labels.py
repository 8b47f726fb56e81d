"""The ways in which the labels of two bodies can be wrong: one function and one entry of ``KINDS`` each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import permutations

import numpy as np

from kinematics.faults.mislabelled.two_bodies import BAD, BETTER, GOOD, Pair
from stapeskit.warnings import Notice

# Runs of which all orders are tried, and the largest shift in lines: they bound the time.
_MOST_RUNS, _REACH = 4, 5
TURN = "check on which side the laser head was, and turn the sign or the directions of one body."
# A motion under other labels, and what the sentence of its kind says of them.
Labelled = tuple[Pair, dict[str, object]]


def _other_sign(pair: Pair) -> Iterator[Labelled]:
    yield replace(pair, base=-pair.base), {}


def _other_names(pair: Pair) -> Iterator[Labelled]:
    yield replace(pair, structure=pair.base, base=pair.structure, sd=pair.sd[:, ::-1]), {}


def _conjugate(pair: Pair) -> Iterator[Labelled]:
    """Yield the conjugate, also with the sign of conjugate velocities, which are i w times displacements."""
    for sign in (1.0, -1.0):
        yield replace(pair, base=sign * pair.base.conj()), {}


def _other_runs(pair: Pair) -> Iterator[Labelled]:
    given = range(len(pair.runs))
    for order in permutations(given) if len(given) <= _MOST_RUNS else ():
        if order != tuple(given):
            sd = np.stack([pair.sd[:, 0], pair.sd[list(order), 1]], axis=1)
            exchanged = [f"{pair.runs[order[run]]} as {pair.runs[run]}" for run in given if order[run] != run]
            yield replace(pair, base=pair.base[list(order)], sd=sd), {"exchanged": ", ".join(exchanged)}


def _other_lines(pair: Pair) -> Iterator[Labelled]:
    """Yield shifted frequencies of one body."""
    freq, count = pair.freq_hz, len(pair.freq_hz)
    for shift in range(-_REACH, _REACH + 1) if count > 8 * _REACH else ():
        if shift:
            here = slice(max(shift, 0), count + min(shift, 0))
            there = slice(max(-shift, 0), count - max(shift, 0))
            shifted = replace(
                pair,
                structure=pair.structure[:, here],
                base=pair.base[:, there],
                sd=np.stack([pair.sd[:, 0, here], pair.sd[:, 1, there]], axis=1),
                freq_hz=freq[here],
            )
            yield shifted, {"hertz": -shift * float(np.median(np.diff(freq))), "lines": abs(shift)}


@dataclass(frozen=True)
class Kind:
    """One way in which labels can be wrong.

    Attributes
    ----------
    labels : function
        Of a pair, to the motion under each other label.
    warning : function
        Of a text, to the warning.
    sentence : str
        What the warning says of these labels; with the names of the bodies, and of that which lags less.
    above : float
        Misfit of the labels as given from which on these are tried.
    """

    labels: Callable[[Pair], Iterator[Labelled]]
    warning: Callable[[str], Notice]
    sentence: str
    above: float = 0.0


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
        """Whether other labels explain the data to twice the noise, and what those as given do not."""
        left = min(GOOD, BETTER * self.given)
        # The farthest shift that was tried is no minimum of the misfit.
        return self.given > BAD and self.misfit < left and self.details.get("lines") != _REACH

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


def compare_labels(pair: Pair) -> Comparison | None:
    """Compare ways to label two bodies by the misfit of one ligament; None with too few lines."""
    as_given = pair.misfit()
    if as_given is None:
        return None
    best = Comparison(as_given, as_given, pair)
    for name, kind in KINDS.items():
        if as_given < kind.above:
            continue
        for other, details in kind.labels(pair):
            misfit = other.misfit()
            if misfit is not None:
                best.least[name] = min(misfit, best.least.get(name, np.inf))
                if misfit < best.misfit:
                    best = replace(best, kind=name, pair=other, details=details, misfit=misfit)
    return best


__all__ = ["KINDS", "TURN", "Comparison", "compare_labels"]
