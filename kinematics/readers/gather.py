"""Gather what a reader found to one recording: units, quantity, lines; the same checks for each format."""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kinematics.readers.lines import check_filled, common_grid
from kinematics.readers.recording import Channel, Recording
from kinematics.readers.text import shown
from kinematics.readers.units import MOTIONS, MotionUnit, motion_unit, split_amplitude
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, list_some, raise_all
from stapeskit.units import FARTHEST_MM, HIGHEST_HZ, LARGEST
from stapeskit.warnings import Notice

_MATRICES = ("value", "sd", "coherence", "n_avg", "common_sd")
_OF_COHERENCE = 1e-4  # rounding of written coherences beyond 0 and 1
_PREFERRED = (1, 0, 2)  # velocity is taken before displacement, and that before acceleration
_LINEAR = "Export velocity or displacement on a linear scale, and name its unit in the file"
_DECIBELS = "Export amplitudes on a linear scale: 10^(dB/20) times the reference"
_ONE_SIGNAL = "Export one signal of one excitation, or name the runs apart"


@dataclass(frozen=True)
class Row:
    """One beam at one point as its file has it.

    Attributes
    ----------
    channel : Channel
        Its order and reference follow from ``unit`` where that is given.
    freq_hz : ndarray, (l,)
        In any order.
    value : ndarray, (l,), complex
    sd, coherence, n_avg, common_sd : number or ndarray, (l,)
        As in `Recording`; ``sd`` in the unit of the value.
    unit : str or MotionUnit, optional
        Of the value, as the file writes it; None: SI, as the channel says.
    source : str
        Its column or variable, for messages.
    """

    channel: Channel
    freq_hz: Array
    value: ComplexArray
    sd: ArrayLike | None = None
    coherence: ArrayLike | None = None
    n_avg: ArrayLike | None = None
    common_sd: ArrayLike | None = None
    unit: str | MotionUnit | None = None
    source: str = ""


def from_parts(real: Array, imaginary: Array, factor: float = 1.0) -> ComplexArray:
    """Return ``factor * (real + i imaginary)``; a complex product would make NaN of infinite parts."""
    value = np.empty(np.shape(real), dtype=complex)
    with np.errstate(over="ignore"):
        value.real, value.imag = real * factor, imaginary * factor
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
    rows = [_ascending(row) for row in rows]
    found, kinds, faults = _in_si(rows)
    raise_all([*faults, *_line_faults(rows)])
    found, notices = _one_quantity(found, file)
    channels = tuple(replace(row.channel, file=file) for row in found)
    grid, matrices, about_lines = matrices_of(found, file)
    if "coherence" in matrices:
        stated = matrices["coherence"]
        near = (stated > -_OF_COHERENCE) & (stated < 1.0 + _OF_COHERENCE)
        matrices["coherence"] = np.where(near, np.clip(stated, 0.0, 1.0), stated)
    raise_all([*twice_faults(channels, matrices["value"], twice), *_range_faults(channels, matrices)])
    kept = grid > 0.0
    if not np.any(kept):
        step = "Export the lines above 0 Hz"
        raise StapeskitError.of("the frequencies", "above 0 Hz", "0 Hz alone", file, step)
    if not np.all(kept):
        text = f"the line at 0 Hz of {file} holds no motion and was dropped."
        about_lines.append(Notice("file_read", text))
        matrices = {name: matrix[:, kept] for name, matrix in matrices.items()}
    facts = {"amplitude_stated": "" not in kinds, **facts}
    facts["notices"] = (*facts.get("notices", ()), *notices, *about_lines)
    return Recording(file, grid[kept], channels=channels, **matrices, **facts)


def matrices_of(rows: Sequence[Row], file: str = "") -> tuple[Array, dict[str, Any], list[Notice]]:
    """Return the common lines (L,) of ascending rows, and by name what they hold on them, (P, L).

    A matrix is NaN where a row has nothing, and is left out where all have nothing.
    """
    grid, places, notices = common_grid([row.freq_hz for row in rows])
    check_filled(len(rows), len(grid), sum(len(row.freq_hz) for row in rows), file)
    matrices = {}
    for name in _MATRICES:
        parts = [getattr(row, name) for row in rows]
        if all(part is None for part in parts):
            continue
        matrix = np.full((len(rows), len(grid)), np.nan, dtype=complex if name == "value" else float)
        for number, part in enumerate(parts):
            if part is not None:
                matrix[number, places[number]] = part
        matrices[name] = matrix
    return grid, matrices, notices


def fault_of(channels: Sequence[Channel], thing: str, expected: str, got: str, step: str) -> Fault:
    """Return one fault of several channels, at all their lines or datasets of the first one's file."""
    first = channels[0].where
    if not isinstance(first, Place):
        return Fault(thing, expected, got, first, step)
    places = [channel.where for channel in channels if isinstance(channel.where, Place)]
    alike = [place for place in places if (place.file, place.unit) == (first.file, first.unit)]
    numbers = sorted({number for place in alike for number in place.numbers})
    return Fault(thing, expected, got, replace(first, numbers=tuple(numbers)), step)


def twice_faults(channels: Sequence[Channel], value: ComplexArray, step: str) -> list[Fault]:
    """Refuse rows of one channel that share lines; one sentence for all of them."""
    groups: dict[Hashable, list[int]] = {}
    for row, channel in enumerate(channels):
        groups.setdefault(channel.key, []).append(row)
    several = [group for group in groups.values() if len(group) > 1]
    again = [group for group in several if np.any(np.sum(~np.isnan(value[group].real), axis=0) > 1)]
    if not again:
        return []
    names = list_some((channels[group[0]].name for group in again), 6)
    thing = f"the channel{'s' if len(again) > 1 else ''} {names}"
    got = f"up to {max(map(len, again))} of them"
    of_all = [channels[row] for group in again for row in group]
    return [fault_of(of_all, thing, "there once in a run", got, step)]


def _ascending(row: Row) -> Row:
    """Return the row with its lines from low to high frequencies."""
    if np.all(np.diff(row.freq_hz) > 0.0):
        return row
    order = np.argsort(row.freq_hz, kind="stable")
    parts = {name: np.asarray(getattr(row, name)) for name in ("freq_hz", *_MATRICES)}
    changed: dict[str, Any] = {name: part[order] for name, part in parts.items() if part.ndim == 1}
    return replace(row, **changed)


def _in_si(rows: Sequence[Row]) -> tuple[list[Row], set[str], list[Fault]]:
    """Return the rows in SI, what they say about peak and rms, and the faults of their units."""
    found: list[Row] = []
    kinds: set[str] = set()
    unknown: dict[str, list[Row]] = {}
    for row in rows:
        if row.unit is None:
            found.append(row)
            kinds.add("")
            continue
        label, kind = ("", "") if isinstance(row.unit, MotionUnit) else split_amplitude(row.unit)
        unit = row.unit if isinstance(row.unit, MotionUnit) else motion_unit(label)
        if unit is None:
            unknown.setdefault(str(row.unit), []).append(row)
            continue
        kinds.add("peak" if unit.per else kind)
        scale = unit.scale * (2.0**0.5 if kind == "rms" and not unit.per else 1.0)
        value = from_parts(np.real(row.value), np.imag(row.value), scale)
        sd = None if row.sd is None else np.asarray(row.sd) * scale
        channel = replace(row.channel, order=unit.order, per=unit.per)
        found.append(replace(row, channel=channel, value=value, sd=sd))
    faults = []
    for label, of_unit in unknown.items():
        step = _DECIBELS if re.search(r"\bdB\b", label, re.IGNORECASE) else _LINEAR
        names = list_some(filter(None, (row.source for row in of_unit)), 4)
        thing, got = f"the unit of {names or 'the values'}", shown(label) or "none"
        faults.append(fault_of([row.channel for row in of_unit], thing, f"one of {MOTIONS}", got, step))
    if "rms" in kinds and len(kinds) > 1:
        got, want = " and ".join(kind or "neither" for kind in sorted(kinds)), "all peak or all rms"
        channels, step = [row.channel for row in rows], "Write it into all units"
        faults.append(fault_of(channels, "the units of the amplitudes", want, got, step))
    return found, kinds, faults


def _line_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse frequencies that are repeated, negative or no numbers; one sentence for all rows."""
    bad: list[Channel] = []
    got: list[str] = []
    for row in rows:
        freq = row.freq_hz
        texts = [f"{one:g}" for one in freq[~((freq >= 0.0) & (freq <= HIGHEST_HZ))].tolist()]
        texts += [f"{one:g} twice" for one in freq[1:][np.diff(freq) == 0.0].tolist()]
        if texts or not len(freq):
            bad.append(row.channel)
            got += texts or ["none"]
    want, step = "finite, different and not negative", "Write every frequency once, in Hz"
    return [fault_of(bad, "the frequencies", want, list_some(got), step)] if bad else []


def _one_quantity(rows: Sequence[Row], file: str) -> tuple[list[Row], list[Notice]]:
    """Keep one quantity of each channel: responses before amplitudes, velocity before others."""
    responses = any(row.channel.per for row in rows)
    kept = [row for row in rows if bool(row.channel.per) == responses]
    best: dict[Hashable, int] = {}
    for row in kept:
        rank = _PREFERRED.index(row.channel.order)
        best[row.channel.key] = min(rank, best.get(row.channel.key, rank))
    kept = [row for row in kept if _PREFERRED.index(row.channel.order) == best[row.channel.key]]
    if len(kept) == len(rows):
        return kept, []
    text = f"{len(rows) - len(kept)} functions of {file} were left out: others of their points were used."
    return kept, [Notice("file_read", text)]


def _range_faults(channels: Sequence[Channel], matrices: dict[str, Any]) -> list[Fault]:
    """Refuse numbers that no motion can have; one sentence a kind."""
    places_mm = 1e3 * np.array([channel.position_m for channel in channels])
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm([channel.direction for channel in channels], axis=1)
    limits: tuple[tuple[str, Array | None, float, float], ...] = (
        ("the values", np.abs(matrices["value"]), 0.0, LARGEST),
        ("the coordinates of the points, in mm", np.abs(places_mm), 0.0, FARTHEST_MM),
        ("the length of a direction", lengths[:, None], 0.999, 1.001),
        ("the standard deviations", matrices.get("sd"), 0.0, LARGEST),
        ("the coherence", matrices.get("coherence"), 0.0, 1.0),
        ("the number of averages", matrices.get("n_avg"), 1.0, LARGEST),
    )
    faults = []
    for thing, numbers, low, high in limits:
        if numbers is None:
            continue
        bad = (numbers < low) | (numbers > high)
        if np.any(bad):
            more = int(np.sum(bad)) - 1
            got = f"{numbers[bad][0]:.6g}" + (f", and {more} more" if more else "")
            want = f"from {low:g} to {high:g}, or missing"
            mine = [channels[row] for row in np.flatnonzero(np.any(bad, axis=1)).tolist()]
            faults.append(fault_of(mine, thing, want, got, "Export it again"))
    sd = matrices.get("sd")
    if sd is not None and np.any(sd == 0.0) and np.any(sd > 0.0):
        mine = [channels[row] for row in np.flatnonzero(np.any(sd == 0.0, axis=1)).tolist()]
        got = f"0 for {int(np.sum(sd == 0.0))} of {int(np.sum(np.isfinite(sd)))} values"
        step = "Leave it empty where it is not known; 0 throughout says that the data have no noise"
        faults.append(fault_of(mine, "the standard deviations", "above 0 where others are", got, step))
    return faults
