"""Settle what a reader found: SI, peak, one quantity, one grid of lines; one set of checks for all."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kinematics.readers.lines import SAME_LINE, check_filled, common_grid
from kinematics.readers.noise import with_noise
from kinematics.readers.recording import NOISE, Recording, Row, from_parts
from kinematics.readers.stated_by_user import FileFacts, with_facts
from kinematics.readers.text import shown
from kinematics.readers.units import HERTZ, MOTIONS, MotionUnit, motion_unit
from stapeskit.faults import Fault, Place, list_some, raise_all
from stapeskit.units import FARTHEST_MM, HIGHEST_HZ, LARGEST
from stapeskit.warnings import Notice

DECIBELS = "Export amplitudes on a linear scale: 10^(dB/20) times the reference"
"""What to do with decibels."""

ONE_EXCITATION = (
    "Put every excitation into a file or a folder of its own, with one signal of each channel, or name the "
    "runs apart"
)

_LOWEST_AUDIBLE_TOP_HZ = 100.0  # a sweep that ends below is in kHz where no unit says so: hearing ends at 20
_OF_COHERENCE = 1e-4  # rounding of written coherences beyond 0 and 1
_PREFERRED = (1, 0, 2)  # velocity is taken before displacement, and that before acceleration
_LINEAR = "Export velocity or displacement on a linear scale, and name its unit in the file"
_UNIT_LENGTH = (0.999, 1.001)  # directions are written with four digits
_AGAIN = "Leave it empty where it is missing, or export it again"
_LENGTH = "Divide it by its length"
_SHARE = "Write it as a share of 1, not of 100; a file that no hand wrote is damaged: export it again"
_LIMITS: tuple[tuple[str, Callable[[Row], ArrayLike | None], float, float, str], ...] = (
    ("the values", lambda row: np.abs(row.value), 0.0, LARGEST, _AGAIN),
    ("the coordinates of points, in mm", lambda row: 1e3 * np.abs(row.position_m), 0.0, FARTHEST_MM, _AGAIN),
    ("the length of a direction", lambda row: np.linalg.norm(row.direction), *_UNIT_LENGTH, _LENGTH),
    ("the standard deviations", lambda row: row.sd, 0.0, LARGEST, _AGAIN),
    ("the coherence", lambda row: row.coherence, 0.0, 1.0, _SHARE),
    ("the number of averages", lambda row: row.n_avg, 1.0, LARGEST, _AGAIN),
)


def settled(found: Recording, facts: FileFacts) -> Recording:
    """Return what a reader found in SI on common lines, with what the user states where the file is silent.

    Units are converted, lines sorted; a line at 0 Hz is dropped with a notice. Of several quantities of a
    channel velocity is kept, of responses and amplitudes the responses. Averages and coherence become an sd.

    Raises
    ------
    StapeskitError
        The faults that the reader found; there is no row; a unit is none of motion or of frequency; peak
        beside rms; frequencies, values or noise that cannot be; directions that are no unit vectors; a
        channel that is there twice. All together, one a kind.
    """
    file, faults, notices = found.file, [*found.faults], [*found.notices]
    rows = [replace(row, file=file) for row in found.rows]
    if not rows and not faults:
        step = "Export the points with their spectra"
        faults.append(Fault("the file", "with values of at least one point", "none", file, step))
    faults += [*_unit_of_lines_faults(rows), *_thousands_faults(rows)]
    rows = _in_si(rows, faults, notices)
    if any(np.any(row.freq_hz == 0.0) for row in rows):
        rows = [_at(row, row.freq_hz != 0.0) if np.any(row.freq_hz != 0.0) else row for row in rows]
        notices.append(Notice("file_read", f"the line at 0 Hz of {file} holds no motion and was dropped."))
    raise_all([*faults, *_line_faults(rows), *_range_faults(rows), *_mirrored_faults(rows)])
    rows, about_lines = on_one_grid(rows, file)
    raise_all(twice_faults(rows))
    rows, lacks, assumed = with_facts(rows, found, facts)
    notices += [*about_lines, *assumed]
    return replace(found, rows=tuple(with_noise(rows)), notices=tuple(notices), lacks=lacks)


def on_one_grid(rows: Sequence[Row], file: str = "") -> tuple[list[Row], list[Notice]]:
    """Return rows of ascending lines on their common lines, NaN at those that a row lacks."""
    grid, places, notices = common_grid([row.freq_hz for row in rows])
    check_filled(len(rows), len(grid), sum(len(row.freq_hz) for row in rows), file)
    placed = []
    for row, place in zip(rows, places, strict=True):
        known = {name: part for name in ("value", *NOISE) if (part := getattr(row, name)) is not None}
        if len(place) < len(grid):
            for name, part in known.items():
                known[name] = np.full(len(grid), np.nan, dtype=complex if name == "value" else float)
                known[name][place] = part
        placed.append(replace(row, freq_hz=grid, lines=None, **known))
    return placed, notices


def twice_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse rows of one channel that share lines; one sentence for all of them."""
    groups = defaultdict[Hashable, list[Row]](list)
    for row in rows:
        groups[row.key].append(row)
    several = [group for group in groups.values() if len(group) > 1]
    again = [one for one in several if np.any(sum(~np.isnan(row.value.real) + 0 for row in one) > 1)]
    names = list_some((group[0].name for group in again), 6)
    got = f"up to {max(map(len, again), default=0)} of them"
    thing = f"the channel{'s' if len(again) > 1 else ''} {names}"
    bad = [(row, None) for group in again for row in group]
    return _faults_of(bad, thing, "there once in a run", got, ONE_EXCITATION)


def _faults_of(
    bad: Sequence[tuple[Row, Any]], thing: str, expected: str, got: str, step: str, column: str = ""
) -> list[Fault]:
    """Return one fault of several rows, each with a mask of its lines or None; none without a row.

    Its place is that of all lines, datasets ... of the first one's file.
    """
    if not bad:
        return []
    first = bad[0][0].where
    if not isinstance(first, Place):
        return [Fault(thing, expected, got, first, step)]
    numbers = set[int]()
    for row, mask in bad:
        if isinstance(row.where, Place) and (row.where.file, row.where.unit) == (first.file, first.unit):
            lines = None if row.lines is None or mask is None else row.lines[mask]
            numbers |= set(row.where.numbers if lines is None else lines.astype(int).tolist())
    where = replace(first, numbers=tuple(sorted(numbers)), detail=column or first.detail)
    return [Fault(thing, expected, got, where, step)]


def _in_si(rows: Sequence[Row], faults: list[Fault], notices: list[Notice]) -> list[Row]:
    """Return the rows of one quantity, in SI, with ascending lines; add what is wrong and left out."""
    found, unknown = list[Row](), defaultdict[str, list[tuple[Row, None]]](list)
    amplitudes = set[str]()
    for row in rows:
        unit = motion_unit(row.unit) if isinstance(row.unit, str) else row.unit
        if unit is None:
            unknown[str(row.unit)].append((row, None))
            continue
        amplitudes.add("peak" if unit.per else unit.amplitude)
        found.append(_converted(row, unit))
    for label, of_unit in unknown.items():
        step = DECIBELS if re.search(r"\bdB\b", label, re.IGNORECASE) else _LINEAR
        names = list_some(filter(None, (row.source for row, _ in of_unit)), 4)
        thing, got = f"the unit of {names or 'the values'}", shown(label) or "none"
        faults += _faults_of(of_unit, thing, f"one of {MOTIONS}", got, step)
    if "rms" in amplitudes and len(amplitudes) > 1:
        got = " and ".join(kind or "neither" for kind in sorted(amplitudes))
        thing, want = "the units of the amplitudes", "all peak or all rms"
        faults += _faults_of([(row, None) for row in rows], thing, want, got, "Write it into all units")
    kept = _of_one_quantity(found)
    if len(kept) < len(found):
        text = f"{len(found) - len(kept)} functions of {found[0].file} were left out: others of their points"
        notices.append(Notice("file_read", f"{text} were used."))
    return kept


def _of_one_quantity(rows: Sequence[Row]) -> list[Row]:
    """Keep one quantity of each channel: responses before amplitudes, velocity before others."""
    responses = any(row.per for row in rows)
    kept = [row for row in rows if bool(row.per) == responses]
    best: dict[Hashable, int] = {}
    for row in kept:
        rank = _PREFERRED.index(row.order)
        best[row.key] = min(rank, best.get(row.key, rank))
    return [row for row in kept if _PREFERRED.index(row.order) == best[row.key]]


def _converted(row: Row, unit: MotionUnit) -> Row:
    """Return the row in Hz, SI and peak, its lines ascending, its noise one number a line."""
    scale = unit.scale * unit.to_peak
    with np.errstate(over="ignore"):
        value = from_parts(np.real(row.value) * scale, np.imag(row.value) * scale)
        sd = None if row.sd is None else np.asarray(row.sd) * scale
    noise: dict[str, Any] = {"sd": sd, "coherence": row.coherence, "n_avg": row.n_avg}
    if row.coherence is not None:
        stated = np.asarray(row.coherence)
        near = (stated > -_OF_COHERENCE) & (stated < 1.0 + _OF_COHERENCE)
        noise["coherence"] = np.where(near, np.clip(stated, 0.0, 1.0), stated)
    for name, part in noise.items():
        noise[name] = None if part is None else np.broadcast_to(part, value.shape)
    freq_hz, length = row.freq_hz * HERTZ.get(row.freq_unit.lower(), 1.0), np.linalg.norm(row.direction)
    direction = row.direction / length if _UNIT_LENGTH[0] <= length <= _UNIT_LENGTH[1] else row.direction
    unit = replace(unit, scale=1.0)
    converted = replace(row, freq_hz=freq_hz, unit=unit, value=value, direction=direction, **noise)
    ascending = bool(np.all(np.diff(freq_hz) > 0.0))
    return converted if ascending else _at(converted, np.argsort(freq_hz, kind="stable"))


def _at(row: Row, lines: Any) -> Row:
    """Return the row with some of its lines, or with its lines in another order."""
    parts = {name: getattr(row, name) for name in ("freq_hz", "value", "lines", *NOISE)}
    return replace(row, **{name: part[lines] for name, part in parts.items() if np.ndim(part)})


def _unit_of_lines_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse frequencies in no unit of frequency, and in none where they may be in kHz as well."""
    thing, stated = "the unit of the frequencies", 'Write it into their name: "freq_hz", "Frequency [kHz]"'
    unknown = [row for row in rows if row.freq_unit and row.freq_unit.lower() not in HERTZ]
    silent = [row for row in rows if not row.freq_unit and len(row.freq_hz)]
    low = [row for row in silent if np.nanmax(row.freq_hz, initial=0.0) <= _LOWEST_AUDIBLE_TOP_HZ]
    labels = list_some((shown(row.freq_unit) for row in unknown), 3)
    spans = list_some(f"none, from {np.min(row.freq_hz):g} to {np.max(row.freq_hz):g}" for row in low)
    return [
        *_faults_of([(row, None) for row in unknown], thing, "Hz, kHz or MHz", labels, stated),
        *_faults_of([(row, None) for row in low], thing, "stated", spans, stated),
    ]


def _thousands_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse frequencies that ascend in the order of the file when 1.05 behind 950 is 1050."""
    bad, got = list[tuple[Row, None]](), list[str]()
    for row in rows:
        for freq in (row.freq_hz, row.freq_hz[::-1]):
            falls = np.flatnonzero(np.diff(freq) < 0.0)
            if not len(falls):
                break
            before, after = freq[: falls[0] + 1], 1000.0 * freq[falls[0] + 1 :]
            follows = before[-1] < 1000.0 <= after[0] <= 2.0 * before[-1]
            if follows and np.all(np.diff(np.concatenate([before, after])) > 0.0):
                bad.append((row, None))
                got.append(f"{after[0] / 1e3:g} behind {before[-1]:g}")
    want, step = "written without marks between thousands", "Write 1050, not 1,050 or 1.050"
    return _faults_of(bad, "the frequencies", want, list_some(got, 2), step)


def _line_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse frequencies that are repeated, negative or no numbers; one sentence for all rows."""
    bad, got = list[tuple[Row, Any]](), list[str]()
    for row in rows:
        freq = row.freq_hz
        odd = ~((freq > 0.0) & (freq <= HIGHEST_HZ))
        again = np.diff(freq) <= SAME_LINE * freq[1:]
        got += [f"{one:g}" for one in freq[odd]] + [f"{one:g} twice" for one in freq[1:][again]]
        odd[1:] |= again
        odd[:-1] |= again
        got += [] if len(freq) else ["none"]
        bad += [(row, odd)] if np.any(odd) or not len(freq) else []
    want = "finite, above 0, and different in one channel and run"
    step = "Write every frequency once, in Hz; number repeats in a column repeat"
    return _faults_of(bad, "the frequencies", want, list_some(got), step)


def _mirrored_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse lines up to the sampling rate: the second half of a whole transform is the first, conjugated."""
    bad = list[tuple[Row, Any]]()
    for row in rows:
        value, mirrored = row.value, row.value[::-1].conj()
        alike = len(value) > 2 and np.allclose(value[:2], mirrored[:2], 1e-6, 0.0)
        turned = np.any(np.abs(value.imag) > 1e-6 * np.abs(value))  # else rounding, as of a constant
        if alike and turned and np.allclose(value, mirrored, 1e-6, 0.0, equal_nan=True):
            bad.append((row, np.arange(len(value)) >= len(value) // 2))
    got, step = "a second half that mirrors the first", "Keep the lines up to half the sampling rate"
    return _faults_of(bad, "the spectra", "one-sided", got, step)


def _range_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse numbers that no motion can have; one sentence a kind."""
    faults = []
    for thing, numbers_of, low, high, step in _LIMITS:
        bad, numbers = list[tuple[Row, Any]](), list[float]()
        for row in rows:
            with np.errstate(over="ignore"):
                own = np.atleast_1d(np.asarray(numbers_of(row), dtype=float))
            outside = (own < low) | (own > high)
            if np.any(outside):
                bad.append((row, outside if own.shape == row.freq_hz.shape else ...))
                numbers += own[outside].tolist()
        got = f"{numbers[0]:.6g}" if numbers else ""
        got += f", and {len(numbers) - 1} more" if len(numbers) > 1 else ""
        want = f"from {low:g} to {high:g}, or missing"
        column = list_some(row.source for row, _ in bad if thing == "the values" and row.lines is not None)
        faults += _faults_of(bad, thing, want, got, step, column)
    sd = [(row, np.asarray(row.sd)) for row in rows if row.sd is not None]
    exact = [(row, own == 0.0) for row, own in sd if np.any(own == 0.0)]
    if any(np.any(own > 0.0) for _, own in sd):
        count = sum(int(np.sum(own)) for _, own in exact), sum(int(np.sum(np.isfinite(own))) for _, own in sd)
        step = "Leave it empty where it is not known; 0 throughout says that the data have no noise"
        got, want = f"0 for {count[0]} of {count[1]} values", "above 0 where others are"
        faults += _faults_of(exact, "the standard deviations", want, got, step)
    return faults
