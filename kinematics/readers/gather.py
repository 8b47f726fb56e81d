"""Gather what a reader found to one recording: units, quantity, lines, and the same checks for each."""

from __future__ import annotations

import re
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kinematics.readers.lines import check_filled, common_grid
from kinematics.readers.recording import QUANTITY_OF_ORDER, Channel, Recording
from kinematics.readers.text import shown
from kinematics.readers.units import MOTIONS, MotionUnit, motion_unit, split_amplitude
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, StapeskitError, list_some, raise_all
from stapeskit.units import FARTHEST_MM, HIGHEST_HZ, LARGEST
from stapeskit.warnings import Notice

_MATRICES = ("value", "sd", "coherence", "n_avg", "common_sd")
_OF_COHERENCE = 1e-4  # rounding of written coherences beyond 0 and 1
_LINEAR = "Export velocity or displacement on a linear scale, and name its unit in the file or in a mapping"
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


def recording_of(
    file: str, rows: Sequence[Row], amplitude: str = "", twice: str = _ONE_SIGNAL, **facts: Any
) -> Recording:
    """Gather rows to one recording in SI.

    Units are converted, frequencies sorted and joined to one grid; a line at 0 Hz is dropped with a notice.
    Of several quantities of a channel velocity is kept, of responses and amplitudes the responses.

    Parameters
    ----------
    amplitude : str
        ``peak`` or ``rms`` for all rows; empty: as the units say.
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
    found, kinds, faults = _in_si(rows, amplitude)
    raise_all([*faults, *_frequency_faults(rows), *_direction_faults(rows)])
    found, notices = _one_quantity([_ascending(row) for row in found], file)
    grid, places, about_lines = common_grid([row.freq_hz for row in found])
    check_filled(len(found), len(grid), sum(len(row.freq_hz) for row in found), file)
    matrices = {
        name: matrix for name in _MATRICES if (matrix := _matrix(name, found, places, len(grid))) is not None
    }
    if "coherence" in matrices:
        stated = matrices["coherence"]
        near = (stated > -_OF_COHERENCE) & (stated < 1.0 + _OF_COHERENCE)
        matrices["coherence"] = np.where(near, np.clip(stated, 0.0, 1.0), stated)
    channels = [row.channel for row in found]
    raise_all([*twice_faults(channels, matrices["value"], twice), *_range_faults(channels, matrices, file)])
    kept = grid > 0.0
    if not np.all(kept):
        about_lines.append(
            Notice("file_read", f"the line at 0 Hz of {file} holds no motion and was dropped.")
        )
        matrices = {name: matrix[:, kept] for name, matrix in matrices.items()}
    if not np.any(kept):
        step = "Export the lines above 0 Hz"
        raise StapeskitError.of("the frequencies", "above 0 Hz", "0 Hz alone", file, step)
    facts = {"amplitude_stated": "" not in kinds, **facts}
    facts["notices"] = (*facts.get("notices", ()), *notices, *about_lines)
    named = tuple(replace(channel, file=file) for channel in channels)
    return Recording(file, grid[kept], channels=named, **matrices, **facts)


def joined_place(channels: Sequence[Channel]) -> Place | str:
    """Return the one place of several channels: all lines or datasets of the first one's file."""
    first = channels[0].where
    if not isinstance(first, Place):
        return first
    places = [channel.where for channel in channels if isinstance(channel.where, Place)]
    alike = [place for place in places if (place.file, place.unit) == (first.file, first.unit)]
    return replace(first, numbers=tuple(sorted({number for place in alike for number in place.numbers})))


def twice_faults(channels: Sequence[Channel], value: ComplexArray, step: str) -> list[Fault]:
    """Refuse rows of one channel that share lines; one sentence for all of them."""
    groups: dict[Hashable, list[int]] = {}
    for row, channel in enumerate(channels):
        groups.setdefault(channel.key, []).append(row)
    again = [
        group
        for group in groups.values()
        if len(group) > 1 and np.any(np.sum(~np.isnan(value[group].real), axis=0) > 1)
    ]
    if not again:
        return []
    names = list_some((channels[group[0]].name for group in again), 6)
    thing = f"the channel{'s' if len(again) > 1 else ''} {names}"
    where = joined_place([channels[row] for group in again for row in group])
    return [Fault(thing, "there once in a run", f"up to {max(map(len, again))} of them", where, step)]


def _in_si(rows: Sequence[Row], amplitude: str) -> tuple[list[Row], set[str], list[Fault]]:
    """Return the rows in SI, what they say about peak and rms, and the faults of their units."""
    found: list[Row] = []
    kinds: set[str] = set()
    unknown: dict[str, list[Channel]] = {}
    names: dict[str, list[str]] = {}
    for row in rows:
        if row.unit is None:
            found.append(row)
            kinds.add(amplitude)
            continue
        label, kind = ("", "") if isinstance(row.unit, MotionUnit) else split_amplitude(row.unit)
        unit = row.unit if isinstance(row.unit, MotionUnit) else motion_unit(label)
        if unit is None:
            unknown.setdefault(str(row.unit), []).append(row.channel)
            names.setdefault(str(row.unit), []).append(row.source)
            continue
        kind = amplitude or kind
        kinds.add("peak" if unit.per else kind)
        scale = unit.scale * (2.0**0.5 if kind == "rms" and not unit.per else 1.0)
        found.append(
            replace(
                row,
                channel=replace(row.channel, order=unit.order, per=unit.per),
                value=from_parts(np.real(row.value), np.imag(row.value), scale),
                sd=None if row.sd is None else np.asarray(row.sd) * scale,
            )
        )
    faults = []
    for label, of_unit in unknown.items():
        step = _DECIBELS if re.search(r"\bdB\b", label, re.IGNORECASE) else _LINEAR
        thing = f"the unit of {list_some(filter(None, names[label]), 4) or 'the values'}"
        got = shown(label) or "none"
        faults.append(Fault(thing, f"one of {MOTIONS}", got, joined_place(of_unit), step))
    if "rms" in kinds and len(kinds) > 1:
        got, step = " and ".join(kind or "neither" for kind in sorted(kinds)), "Write it into all units"
        faults.append(
            Fault(
                "the units of the amplitudes",
                "all peak or all rms",
                got,
                joined_place([row.channel for row in rows]),
                step,
            )
        )
    return found, kinds, faults


def _frequency_faults(rows: Sequence[Row]) -> list[Fault]:
    """Refuse frequencies that are repeated, negative or no numbers; one sentence for all rows."""
    bad: list[Channel] = []
    got: list[str] = []
    checked: dict[bytes, list[str]] = {}
    for row in rows:
        key = np.ascontiguousarray(row.freq_hz).tobytes()
        if key not in checked:
            freq = np.sort(row.freq_hz)
            others = freq[~((freq >= 0.0) & (freq <= HIGHEST_HZ))]
            again = freq[1:][np.diff(freq) == 0.0]
            checked[key] = [*(f"{one:g}" for one in others), *(f"{one:g} twice" for one in again)]
            checked[key] += [] if len(freq) else ["none"]
        if checked[key]:
            bad.append(row.channel)
            got += checked[key]
    if not bad:
        return []
    want, step = "finite, different and not negative", "Write every frequency once, in Hz"
    return [Fault("the frequencies", want, list_some(got), joined_place(bad), step)]


def _direction_faults(rows: Sequence[Row]) -> list[Fault]:
    faults = []
    for row in rows:
        with np.errstate(over="ignore"):
            length = float(np.linalg.norm(row.channel.direction))
        if abs(length - 1.0) > 1e-3:  # not so for NaN
            got, step = f"length {length:.4g}", "Divide the direction by its length"
            faults.append(Fault("a direction", "a unit vector (within 1e-3)", got, row.channel.where, step))
    return faults


def _ascending(row: Row) -> Row:
    """Return the row with its lines from low to high frequencies."""
    if np.all(np.diff(row.freq_hz) > 0.0):
        return row
    order = np.argsort(row.freq_hz, kind="stable")
    parts: dict[str, Any] = {name: getattr(row, name) for name in ("freq_hz", *_MATRICES)}
    arrays = {name: part for name, part in parts.items() if np.ndim(part) == 1}
    return replace(row, **{name: part[order] for name, part in arrays.items()})


def _one_quantity(rows: Sequence[Row], file: str) -> tuple[list[Row], list[Notice]]:
    """Keep one quantity of each channel: responses before amplitudes, velocity before others."""
    responses = any(row.channel.per for row in rows)
    rank = {1: 0, 0: 1, 2: 2}
    best: dict[Hashable, int] = {}
    for row in rows:
        if row.channel.per or not responses:
            order = row.channel.order
            best[row.channel.key] = min(best.get(row.channel.key, order), order, key=rank.__getitem__)
    kept, left = list[Row](), list[Row]()
    for row in rows:
        good = (row.channel.per or not responses) and best[row.channel.key] == row.channel.order
        (kept if good else left).append(row)
    if not left:
        return kept, []
    used, others = (" and ".join(sorted({_quantity(row.channel) for row in part})) for part in (kept, left))
    text = f"{file} holds {used}, used here, and {others} of the same points, left out."
    return kept, [Notice("file_read", text)]


def _quantity(channel: Channel) -> str:
    quantity = QUANTITY_OF_ORDER[channel.order]
    return f"{quantity} per {channel.per}" if channel.per else quantity


def _matrix(name: str, rows: Sequence[Row], places: Sequence[Any], lines: int) -> Any:
    """Return one part of all rows on the common grid, (P, L), NaN where it is missing; None without any."""
    parts = [getattr(row, name) for row in rows]
    if all(part is None for part in parts):
        return None
    matrix = np.full((len(rows), lines), np.nan, dtype=complex if name == "value" else float)
    for number, part in enumerate(parts):
        if part is not None:
            matrix[number, places[number]] = part
    return matrix


def _range_faults(channels: Sequence[Channel], matrices: dict[str, Any], file: str) -> list[Fault]:
    """Refuse numbers that no motion can have; one sentence a kind."""
    places_mm = 1e3 * np.array([channel.position_m for channel in channels])
    limits: tuple[tuple[str, Array | None, float, float], ...] = (
        ("the values", np.abs(matrices["value"]), 0.0, LARGEST),
        ("the coordinates of the points, in mm", np.abs(places_mm), 0.0, FARTHEST_MM),
        ("the standard deviations", matrices.get("sd"), 0.0, LARGEST),
        ("the coherence", matrices.get("coherence"), 0.0, 1.0),
        ("the number of averages", matrices.get("n_avg"), 1.0, LARGEST),
    )
    faults = []
    for thing, numbers, low, high in limits:
        bad = (numbers < low) | (numbers > high) if numbers is not None else np.zeros((0, 0))
        if numbers is not None and np.any(bad):
            count = int(np.sum(bad))
            got = f"{numbers[bad][0]:.6g}" + (f" and {count - 1} more" if count > 1 else "")
            want = f"from {low:g} to {high:g}, or NaN where missing"
            where = joined_place([channels[row] for row in np.flatnonzero(np.any(bad, axis=1)).tolist()])
            faults.append(Fault(thing, want, got, where or file, "Export it again"))
    return faults
