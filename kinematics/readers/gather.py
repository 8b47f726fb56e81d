"""Gather the rows that a reader found to one recording: units, quantity, lines; one set of checks for all."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kinematics.readers.lines import check_filled, common_grid
from kinematics.readers.recording import Recording, Row
from kinematics.readers.text import shown
from kinematics.readers.units import MOTIONS, MotionUnit, motion_unit
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, list_some, raise_all
from stapeskit.units import FARTHEST_MM, HIGHEST_HZ, LARGEST
from stapeskit.warnings import Notice

NOISE = ("sd", "coherence", "n_avg")
"""Numbers of a row beside its values; a matrix of each may be there or not."""

DECIBELS = "Export amplitudes on a linear scale: 10^(dB/20) times the reference"
"""What to do with decibels."""

_OF_COHERENCE = 1e-4  # rounding of written coherences beyond 0 and 1
_PREFERRED = (1, 0, 2)  # velocity is taken before displacement, and that before acceleration
_LINEAR = "Export velocity or displacement on a linear scale, and name its unit in the file"
_ONE_SIGNAL = "Export one signal of one excitation, or name the runs apart"
_LIMITS: tuple[tuple[str, Callable[[Row], ArrayLike | None], float, float], ...] = (
    ("the values", lambda row: np.abs(row.value), 0.0, LARGEST),
    ("the coordinates of the points, in mm", lambda row: np.abs(1e3 * row.position_m), 0.0, FARTHEST_MM),
    ("the length of a direction", lambda row: np.linalg.norm(row.direction), 0.999, 1.001),
    ("the standard deviations", lambda row: row.sd, 0.0, LARGEST),
    ("the coherence", lambda row: row.coherence, 0.0, 1.0),
    ("the number of averages", lambda row: row.n_avg, 1.0, LARGEST),
)


def from_parts(real: Array, imaginary: Array) -> ComplexArray:
    """Return ``real + i imaginary``; a complex product would make NaN of infinite parts."""
    value = np.empty(np.shape(real), dtype=complex)
    value.real, value.imag = real, imaginary
    return value


def from_polar(magnitude: Array, phase: Array, turn: float) -> ComplexArray:
    """Return complex numbers of magnitudes and of phases in units of ``turn`` radians."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(magnitude * np.exp(1j * turn * phase))


def recording_of(file: str, rows: Sequence[Row], twice: str = _ONE_SIGNAL, **facts: Any) -> Recording:
    """Gather rows to one recording in SI.

    Units are converted, frequencies sorted and joined to one grid; a line at 0 Hz is dropped with a notice.
    Of several quantities of a channel velocity is kept, of responses and amplitudes the responses.

    Parameters
    ----------
    twice : str
        What to do where a channel is there twice.
    facts
        Other attributes of `Recording`.

    Raises
    ------
    StapeskitError
        There is no row; a unit is none of motion; peak beside rms; frequencies, values or noise that cannot
        be; directions that are no unit vectors; a channel that is there twice. All together, one a kind.
    """
    if not rows:
        step = "Export the points with their spectra"
        raise StapeskitError.of("the file", "with values of at least one point", "none", file, step)
    raise_all(_thousands_faults(rows))
    rows, faults = _in_si([replace(row, file=file) for row in rows])
    raise_all([*faults, *_line_faults(rows)])
    kinds = {"peak" if row.per else row.unit.amplitude for row in rows if isinstance(row.unit, MotionUnit)}
    rows, about_quantity = _one_quantity(rows, file)
    rows, about_lines = on_one_grid(rows, file)
    raise_all([*twice_faults(rows, twice), *_range_faults(rows)])
    above = rows[0].freq_hz > 0.0
    if not np.any(above):
        step = "Export the lines above 0 Hz"
        raise StapeskitError.of("the frequencies", "above 0 Hz", "0 Hz alone", file, step)
    if not np.all(above):
        rows = [_at(row, above) for row in rows]
        text = f"the line at 0 Hz of {file} holds no motion and was dropped."
        about_lines.append(Notice("file_read", text))
    notices = (*facts.pop("notices", ()), *about_quantity, *about_lines)
    return Recording(file, tuple(rows), notices, amplitude_stated="" not in kinds, **facts)


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
        placed.append(replace(row, freq_hz=grid, **known))
    return placed, notices


def _at(row: Row, lines: Any) -> Row:
    """Return the row with some of its lines, or with its lines in another order."""
    parts = {name: getattr(row, name) for name in ("freq_hz", "value", *NOISE)}
    return replace(row, **{name: part[lines] for name, part in parts.items() if np.ndim(part)})


def fault_of(rows: Sequence[Row], thing: str, expected: str, got: str, step: str) -> Fault:
    """Return one fault of several rows, at all their lines or datasets of the first one's file."""
    first = rows[0].where
    if not isinstance(first, Place):
        return Fault(thing, expected, got, first, step)
    places = [row.where for row in rows if isinstance(row.where, Place)]
    alike = [place for place in places if (place.file, place.unit) == (first.file, first.unit)]
    numbers = sorted({number for place in alike for number in place.numbers})
    return Fault(thing, expected, got, replace(first, numbers=tuple(numbers)), step)


def twice_faults(rows: Sequence[Row], step: str) -> list[Fault]:
    """Refuse rows of one channel that share lines; one sentence for all of them."""
    groups = defaultdict[Hashable, list[Row]](list)
    for row in rows:
        groups[row.key].append(row)
    several = [group for group in groups.values() if len(group) > 1]
    again = [one for one in several if np.any(sum(~np.isnan(row.value.real) + 0 for row in one) > 1)]
    if not again:
        return []
    names = list_some((group[0].name for group in again), 6)
    thing = f"the channel{'s' if len(again) > 1 else ''} {names}"
    got = f"up to {max(map(len, again))} of them"
    return [fault_of([row for group in again for row in group], thing, "there once in a run", got, step)]


def _in_si(rows: Sequence[Row]) -> tuple[list[Row], list[Fault]]:
    """Return the rows in SI, their lines ascending, and the faults of their units."""
    found, faults = list[Row](), list[Fault]()
    unknown, amplitudes = defaultdict[str, list[Row]](list), defaultdict[str, list[Row]](list)
    for row in rows:
        unit = motion_unit(row.unit) if isinstance(row.unit, str) else row.unit
        if unit is None:
            unknown[str(row.unit)].append(row)
            continue
        amplitudes["peak" if unit.per else unit.amplitude].append(row)
        found.append(_converted(row, unit))
    for label, of_unit in unknown.items():
        step = DECIBELS if re.search(r"\bdB\b", label, re.IGNORECASE) else _LINEAR
        names = list_some(filter(None, (row.source for row in of_unit)), 4)
        thing, got = f"the unit of {names or 'the values'}", shown(label) or "none"
        faults.append(fault_of(of_unit, thing, f"one of {MOTIONS}", got, step))
    if "rms" in amplitudes and len(amplitudes) > 1:
        got = " and ".join(kind or "neither" for kind in sorted(amplitudes))
        thing, want = "the units of the amplitudes", "all peak or all rms"
        faults.append(fault_of(rows, thing, want, got, "Write it into all units"))
    return found, faults


def _converted(row: Row, unit: MotionUnit) -> Row:
    """Return the row in SI and peak, its lines ascending, its noise one number a line."""
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
    converted = replace(row, unit=replace(unit, scale=1.0), value=value, **noise)
    if np.all(np.diff(row.freq_hz) > 0.0):
        return converted
    return _at(converted, np.argsort(row.freq_hz, kind="stable"))


def _line_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse frequencies that are repeated, negative or no numbers; one sentence for all rows."""
    bad, got = list[Row](), list[str]()
    for row in rows:
        freq = row.freq_hz
        texts = [f"{one:g}" for one in freq[~((freq >= 0.0) & (freq <= HIGHEST_HZ))].tolist()]
        texts += [f"{one:g} twice" for one in freq[1:][np.diff(freq) == 0.0].tolist()]
        if texts or not len(freq):
            bad.append(row)
            got += texts or ["none"]
    want, step = "finite, different and not negative", "Write every frequency once, in Hz"
    return [fault_of(bad, "the frequencies", want, list_some(got), step)] if bad else []


def _thousands_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse frequencies that ascend in the order of the file when 1.05 behind 950 is 1050."""
    bad, got = list[Row](), list[str]()
    for row in rows:
        for freq in (row.freq_hz, row.freq_hz[::-1]):
            falls = np.flatnonzero(np.diff(freq) < 0.0)
            if not len(falls):
                break
            before, after = freq[: falls[0] + 1], 1000.0 * freq[falls[0] + 1 :]
            follows = before[-1] < 1000.0 <= after[0] <= 2.0 * before[-1]
            if follows and np.all(np.diff(np.concatenate([before, after])) > 0.0):
                bad.append(row)
                got.append(f"{after[0] / 1e3:g} behind {before[-1]:g}")
    want, step = "written without marks between thousands", "Write 1050, not 1,050 or 1.050"
    return [fault_of(bad, "the frequencies", want, list_some(got, 2), step)] if bad else []


def _one_quantity(rows: Sequence[Row], file: str) -> tuple[list[Row], list[Notice]]:
    """Keep one quantity of each channel: responses before amplitudes, velocity before others."""
    responses = any(row.per for row in rows)
    kept = [row for row in rows if bool(row.per) == responses]
    best: dict[Hashable, int] = {}
    for row in kept:
        rank = _PREFERRED.index(row.order)
        best[row.key] = min(rank, best.get(row.key, rank))
    kept = [row for row in kept if _PREFERRED.index(row.order) == best[row.key]]
    text = f"{len(rows) - len(kept)} functions of {file} were left out: others of their points were used."
    return kept, [Notice("file_read", text)] if len(kept) < len(rows) else []


def _range_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse numbers that no motion can have; one sentence a kind."""
    faults = []
    for thing, numbers_of, low, high in _LIMITS:
        bad, numbers = list[Row](), list[float]()
        for row in rows:
            with np.errstate(over="ignore"):
                own = np.atleast_1d(np.asarray(numbers_of(row), dtype=float))
            outside = own[(own < low) | (own > high)].tolist()
            bad += [row] if outside else []
            numbers += outside
        if bad:
            got = f"{numbers[0]:.6g}" + (f", and {len(numbers) - 1} more" if len(numbers) > 1 else "")
            want = f"from {low:g} to {high:g}, or missing"
            faults.append(fault_of(bad, thing, want, got, "Export it again"))
    sd = [np.asarray(row.sd) for row in rows if row.sd is not None]
    exact = [row for row in rows if row.sd is not None and np.any(np.asarray(row.sd) == 0.0)]
    if exact and any(np.any(own > 0.0) for own in sd):
        count = [sum(int(np.sum(test(own))) for own in sd) for test in (lambda own: own == 0.0, np.isfinite)]
        got = "0 for {} of {} values".format(*count)
        step = "Leave it empty where it is not known; 0 throughout says that the data have no noise"
        faults.append(fault_of(exact, "the standard deviations", "above 0 where others are", got, step))
    return faults
