"""The catalogue of alternatives: ways in which readings can have been labelled, scaled or ordered otherwise.

Each is one entry of ALTERNATIVES. To add one, write a function that yields what the readings would be, and
an entry with its sentence; search, warnings, report and correction follow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from legacy.kinematics.faults.proposals import body_labels, exchanges, line_orders, row_places, unit_slips
from legacy.kinematics.faults.proposals.drifting_motion import drifting_motion
from legacy.kinematics.faults.proposals.gains import drifting_points, scattered_gains
from legacy.kinematics.faults.proposals.outliers import outliers
from legacy.kinematics.faults.proposals.two_bodies import BAD
from legacy.kinematics.faults.proposals.whole_parts import conjugated, mains, ranges
from legacy.stapeskit.option_names import written
from legacy.stapeskit.warnings import Notice

Words = Mapping[str, object]


@dataclass(frozen=True)
class Alternative:
    """One way in which readings can have been labelled, scaled or ordered otherwise.

    Attributes
    ----------
    of : str
        What is proposed otherwise, and so what decides. Every slip of ``units`` is reported, and else of the
        ``speed``; an ``exchange`` is fitted as a fault without a size (``search``); ``rows`` are judged by
        the motion that other channels show (``row_labels``), a ``misfit`` by what is left to be found
        (``explain``), ``lines`` by the ``course`` of the motion (``line_order``), and a ``pair`` of bodies,
        their ``size`` and ``lag`` by one ligament (``phase_convention``).
    propose : callable
        From that to what stands in its place, and what the sentence says of it.
    sentence : str
        What is reported, a format of these words.
    code : str
        Of its warning; empty where that is the code of the verdict.
    verdict : str
        Of the channels.
    step : str
        What to do, a format of the same words, in which options stand as ``{{option}}``.
    above : float
        Least misfit for it to be tried, in the measure of what decides (see ``of``).
    estimate : str
        What is said of a correction, where that is not the sentence.
    of_channels : bool
        It is made of faults of single channels: believed only when it leaves none, and not corrected.
    """

    of: str
    propose: Callable[[Any], Iterator[tuple[Any, Words]]]
    sentence: str
    code: str = ""
    verdict: str = "label_swap"
    step: str = ""
    above: float = 0.0
    estimate: str = ""
    of_channels: bool = False


@dataclass(frozen=True)
class Proposal:
    """The readings as an alternative takes them, and the words of its sentence."""

    name: str
    value: Any
    words: Words

    @property
    def entry(self) -> Alternative:
        """Its alternative."""
        return ALTERNATIVES[self.name]

    @property
    def text(self) -> str:
        """The sentence."""
        return self.entry.sentence.format(**self.words)

    @property
    def step(self) -> str:
        """What to do."""
        return written(self.entry.step.format(**self.words))

    def notice(self, before: str = "") -> Notice:
        """Return its warning."""
        return Notice(self.entry.code or self.entry.verdict, before + self.text)


def proposed(of: str, given: Any, misfit: float = float("inf")) -> Iterator[Proposal]:
    """Yield the readings as every alternative of a sort takes them, in the order of the table."""
    for name, entry in ALTERNATIVES.items():
        if entry.of == of and misfit >= entry.above:
            for value, words in entry.propose(given):
                yield Proposal(name, value, words)


# A cause of a body that does not seem to bend is looked for among outliers alone.
BENDS = 1.0
_TURN = "check on which side the laser head was, and turn the sign or the directions of one body."
_LEADS = (
    "{structure} leads {base} at {leading} of {sure} lines ({lead:.0f} standard deviations), which no "
    "passive ligament does"
)
_DRIFTED = (
    "The motion changed while the points were recorded one after the other (drying, drift of the source): "
    "measure the first point again at the end, or give a reference recorded with each point"
)
_RELABEL = "Correct body, run or freq_hz of these rows"
_PUT_RIGHT = "Check the ranges of the vibrometer, and correct the values of that body"
ALTERNATIVES: dict[str, Alternative] = {
    "points in another unit": Alternative(
        "units",
        unit_slips.points,
        "the points of body {body} lie within {size:.3g} mm of each other: their coordinates look like "
        "{unit} under a header in mm. Give them in mm, or correct the names of the columns.",
        "unit_slip",
    ),
    "frequencies in another unit": Alternative(
        "units",
        unit_slips.frequencies,
        "the highest frequency is {highest:.4g} Hz, {found}. Give them in Hz.",
        "unit_slip",
    ),
    "bodies in different units": Alternative(
        "units",
        unit_slips.ratios,
        "body {body} moves {ratio:.3g} times as much as body {first} (median): their readings are hardly in "
        "the same unit. Check m, mm, um, nm in their rows or files.",
        "unit_slip",
    ),
    "phases in radians": Alternative(
        "units",
        unit_slips.phases,
        "all phases of body {body} lie between -3.142 and 3.142 degrees: they look like radians under a "
        "header in degrees. Give them in degrees (times 57.296).",
        "unit_slip",
    ),
    "decibels": Alternative(
        "units",
        unit_slips.decibels,
        "body {body} moves as a rigid body only when its amplitudes are taken as decibels ({after:.2g} % of "
        "them are no rigid motion then, {given:.2g} % as given). Give amplitudes, 10^(dB/20) times the "
        "reference.",
        "unit_slip",
    ),
    "all in another unit": Alternative(
        "speed",
        unit_slips.velocities,
        "{bodies} move by {size:.2g} m/s (median; acceleration {acceleration:.2g} m/s^2){noisy}; ears in "
        "experiments move by {slowest:g} to {fastest:g} m/s. The values look {factor:g} times too {off} for "
        "their header, such as {pair}: check it, unless these are responses per unit of a reference.",
        "plausibility",
    ),
    "two points": Alternative("exchange", exchanges.two_points, "points {points} exchanged{beams}"),
    "three points": Alternative(
        "exchange", exchanges.three_points, "three points exchanged: the rows of {rows}{beams}"
    ),
    "two beams": Alternative("exchange", exchanges.two_beams, "two beams of point {point} exchanged"),
    "two lasers": Alternative("exchange", exchanges.two_lasers, "two lasers exchanged at all points"),
    "coordinates of a point": Alternative(
        "exchange",
        exchanges.coordinates_of_a_point,
        "{axes} of point {point} look exchanged: {right} would be right",
        verdict="position",
    ),
    "coordinates of all points": Alternative(
        "exchange",
        exchanges.coordinates_of_all,
        "{axes} of all points look exchanged",
        verdict="position",
    ),
    "two lines of rows": Alternative(
        "two rows", row_places.two_lines, "rows of {rows} at {first:.6g} and {second:.6g} Hz exchanged"
    ),
    "conjugated rows": Alternative(
        "rows",
        row_places.conjugated,
        "conjugate of what it should read (amplitudes of e^{{-iwt}})",
        verdict="sign",
        step="Turn the sign of its im or phase_deg round",
    ),
    "shifted rows": Alternative(
        "rows",
        row_places.shifted,
        "rows of {rows} belong {lines} {way}: their frequencies are off by {hertz:.4g} Hz",
        step=_RELABEL,
    ),
    "rows of another run": Alternative(
        "rows",
        row_places.other_runs,
        "rows of {rows} under run {run} are those of run {other}",
        step=_RELABEL,
    ),
    "rows of another body": Alternative(
        "rows",
        row_places.other_bodies,
        "{rows} moves with body {other}, at its own position: it belongs to {other}",
        step=_RELABEL,
    ),
    "rows of two bodies": Alternative(
        "rows", row_places.points_of_bodies, "{rows} and point {point} of body {other} exchanged"
    ),
    "conjugated laser": Alternative(
        "misfit",
        conjugated,
        "all {number} beams along that of channel {beam} read the conjugate of what the others show "
        "(amplitudes of e^{{-iwt}})",
        "conjugated_laser",
        "sign",
        "Turn the sign of their im or phase_deg round",
        BENDS,
    ),
    "mains": Alternative(
        "misfit",
        mains,
        "the lines at multiples of {base:.0f} Hz hold mains hum in addition to the motion: {lines} Hz",
        "mains_lines",
        "noise",
        "Leave these lines out (dof2kd {{exclude}} {ranges}), or remove them from the file",
        BENDS,
    ),
    "ranges": Alternative(
        "misfit",
        ranges,
        "{others} of {number} points read {ratio:.4g} times what the others show ({points}): in another "
        "range or unit, or in rms beside peak values{which}",
        "unit_slip",
        "gain",
        "Check the range and the unit of their rows, and correct the values",
        BENDS,
    ),
    "outliers": Alternative(
        "misfit",
        outliers,
        "{number} single values ({share:.2g} %) are {what}, most at channel {channel}",
        "sparse_outliers",
        "noise",
        "Fit with {{robust}} huber, or leave the cells of these values empty",
    ),
    "drift between points": Alternative(
        "misfit",
        drifting_points,
        "the readings change from point to point in the order of the file, by a factor of {factor:.3g} from "
        "point {first} to {last}",
        "drift_between_points",
        "drift",
        _DRIFTED,
        BENDS,
        of_channels=True,
    ),
    "drift of the motion": Alternative(
        "misfit",
        drifting_motion,
        "the motion changes from point to point in the order of the file, by {share:.2g} % of it from point "
        "{first} to {last}",
        "drift_between_points",
        "drift",
        _DRIFTED,
        BENDS,
        of_channels=True,
    ),
    "scattered gains": Alternative(
        "misfit",
        scattered_gains,
        "the gains of the {what} scatter by about {sd:.2g} % (standard deviation), most at {most} (factor "
        "{factor:.4g})",
        "gains_scattered",
        "gain",
        "Calibrate the channels, or state the scatter and fit it with {{calibrate}} {{gain_sd}} {sd:.2g}",
        BENDS,
        of_channels=True,
    ),
    "lines sorted as text": Alternative(
        "lines",
        line_orders.sorted_as_text,
        "{what} of {bodies} look sorted as text ({words}, ...) and not as numbers: {because}. Sort both "
        "columns together.",
        estimate="{what} sorted as text; lines put in the order of their numbers",
    ),
    "two lines": Alternative(
        "course",
        line_orders.two_exchanged,
        "the motion of {bodies} jumps at {first:.6g} and {second:.6g} Hz and is smooth when the rows of the "
        "two lines are exchanged: check their freq_hz.",
        estimate="rows of the lines at {first:.6g} and {second:.6g} Hz exchanged",
    ),
    "sign": Alternative(
        "pair",
        body_labels.other_sign,
        f", but one would with the sign of one of them turned: {_TURN}",
        "body_sign",
    ),
    "bodies": Alternative(
        "pair",
        body_labels.other_names,
        ": the names {structure} and {base} look exchanged{conjugated}. Exchange them.",
    ),
    "conjugate": Alternative(
        "pair",
        body_labels.conjugate,
        ": the data of {leading} alone look like amplitudes of e^{{-iwt}}. Conjugate them (im or phase_deg "
        "with the opposite sign).",
        "phase_convention",
        above=BAD,
    ),
    "runs": Alternative(
        "pair",
        body_labels.other_runs,
        ": runs of {base} look exchanged ({exchanged}), or those of {structure} the other way. Correct the "
        "column run.",
        above=BAD,
    ),
    "frequency": Alternative(
        "pair",
        body_labels.other_lines,
        ": the frequencies of {base} look shifted against those of {structure} by about {hertz:.3g} Hz "
        "({lines} lines). Check freq_hz.",
        above=BAD,
    ),
    "bodies by lag": Alternative(
        "lag",
        body_labels.other_names,
        f"{_LEADS}; {{base}} would lag {{structure}} as a passive ligament makes it: the two names look "
        "exchanged. Exchange them, unless the data are amplitudes of e^{{-iwt}} (then conjugate them).",
    ),
    "sign by lag": Alternative(
        "lag",
        body_labels.other_sign,
        f"{_LEADS}, and moves against it at the lowest lines, where the ligament carries it along: one of "
        f"the two bodies has the wrong sign. {_TURN.capitalize()}",
        "body_sign",
    ),
    "convention": Alternative(
        "lag",
        body_labels.both_conjugate,
        f"{_LEADS}: the data look like amplitudes of e^{{{{-iwt}}}}. Conjugate them (im or phase_deg with "
        "the opposite sign).",
        "phase_convention",
    ),
    "rms": Alternative(
        "size",
        body_labels.rms,
        ": {rms} looks given in rms and {peak} in peak values. Name the columns of {rms} amp_rms or give all "
        "in peak values.",
        "unit_slip",
    ),
    "range": Alternative(
        "size",
        body_labels.another_range,
        f": one of the two bodies looks measured in another range or unit. {_PUT_RIGHT}.",
        "unit_slip",
    ),
    "range of a run": Alternative(
        "size",
        body_labels.range_of_a_run,
        " in run {run} alone: one of the two bodies looks measured in another range or unit there. "
        f"{_PUT_RIGHT} in run {{run}}.",
        "unit_slip",
    ),
}


def slip_notices(measurement: Any) -> list[Notice]:
    """Return one warning for each unit of a Measurement that does not fit its header."""
    slips = [proposal.notice() for proposal in proposed("units", measurement)]
    # A wrong unit of frequencies, or of one body, makes velocities wrong too.
    return slips or [proposal.notice() for proposal in proposed("speed", measurement)]
