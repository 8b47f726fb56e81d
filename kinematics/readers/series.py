"""Read time series (CSV, NPZ, MATLAB, HDF5) as frequency responses by a table of channels.

Files: a CSV with a column ``time_s`` and one column a channel; arrays of samples by the names of their
channels with ``sample_rate_hz`` (``fs``) or ``time_s`` (``t``).

The table of channels, one row a channel::

    channel, role, body, point, dir, unit [, sensitivity] [, x_mm, y_mm, z_mm] [, run] [, file]

``role`` is ``response``, ``reference`` or ``ignore``; ``dir`` an axis or "X,Y,Z". ``unit`` is that of the
numbers times ``sensitivity`` (any unit for a reference): 5 mm/s per volt is 0.005 and m/s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kinematics.readers.points import POSITION, read_named, text_of
from kinematics.readers.recording import Recording, Row, unknown_vector
from kinematics.readers.stated_by_user import FileFacts, direction_of, is_file
from kinematics.readers.text import plain_name, shown
from kinematics.readers.tree import read_tree
from kinematics.readers.units import SI_UNITS, MotionUnit, is_none, motion_unit, plain
from kinematics.signals.frf import periodic_frf, welch_frf
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.units import HIGHEST_HZ, LARGEST
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from stapeskit.tables import Table

ROLES = ("response", "reference", "ignore")
TIMES = ("time_s", "time", "t", "x")
RATES = ("sample_rate_hz", "sample_rate", "fs", "fs_hz")

_NUMBERS = (*POSITION, "sensitivity")
_TEXTS = ("channel", "role", "body", "point", "dir", "unit", "run", "file")
_JITTER = 0.1  # difference of sampling times, in samples, that counts as rounding of written times
_SHORTEST = 16  # samples; shorter records hold no spectrum
_CLIPPED = 3  # neighbouring samples at an extreme, and such stretches: a smooth signal touches it once
_ONE_ROW = "Save each channel under a name of its own, and each record to a file (column file of the table)"


@dataclass(frozen=True)
class Listed:
    """One row of the table of channels.

    ``scale`` leads from the numbers of the file to SI, or to the unit ``per`` of a reference; ``row`` has no
    values yet.
    """

    name: str
    role: str
    file: str
    scale: float
    per: str
    row: Row


def read(path: Path, facts: FileFacts) -> Recording:
    """Read the time series of one file as frequency responses.

    Raises
    ------
    StapeskitError
        No table of channels, a channel that is missing, no or several references, or what is wrong with the
        samples.
    """
    path, notices = Path(path), list[Notice]()
    if facts.channels is None:
        step = "Write a table with channel, role, body, point, dir and unit; see points2dof --help"
        raise StapeskitError.of("time series", "read with --channels FILE", "none", path.name, step)
    listed = [one for one in read_channels(facts.channels) if not one.file or is_file(one.file, path.name)]
    responses = [one for one in listed if one.role == "response"]
    references = [one for one in listed if one.role == "reference"]
    if not responses or len(references) != 1:
        want = f"with responses of {path.name} and one reference (the generator, a microphone)"
        got, step = f"{len(responses)} and {len(references)}", "Give the others the role ignore"
        raise StapeskitError.of("the table of channels", want, got, facts.channels.name, step)
    rate, samples = _read_samples(path, [one.name for one in (*responses, *references)])
    if clipped := [name for name, one in samples.items() if _is_clipped(one)]:
        text = (
            f"{', '.join(clipped)} of {path.name}: neighbouring samples lie at the largest or smallest value "
            "again and again. The responses are too small there: lower the level or take a wider range."
        )
        notices.append(Notice("samples_stuck", text))
    lead = samples[references[0].name] * references[0].scale
    signals = np.array([samples[one.name] * one.scale for one in responses])
    if facts.period_s is not None:
        frf = periodic_frf(lead, signals, rate, facts.period_s, path.name)
    else:
        frf = welch_frf(lead, signals, rate, facts.averages, path.name)
    rows = [
        replace(
            one.row, freq_hz=frf.freq_hz, value=frf.value[k], sd=frf.sd[k], coherence=frf.coherence[k],
            n_avg=frf.n_avg, unit=MotionUnit(one.row.order, per=references[0].per),
        )
        for k, one in enumerate(responses)
    ]  # fmt: skip
    statement, spread = f"time series at {rate:g} Hz", frf.line_spread
    return Recording(path.name, tuple(rows), tuple(notices), statement, line_spread=spread)


def read_channels(path: Path) -> list[Listed]:
    """Read a table of channels, without those to ignore.

    Raises
    ------
    StapeskitError
        A column is missing, a role, unit, sensitivity or direction cannot be read, or a channel is listed
        twice; all faults with their lines.
    """
    table, faults = read_named(path, ("channel", "unit"), (*_TEXTS, *_NUMBERS))
    listed = dict[tuple[str, str], Listed]()
    for line in range(len(table)):
        one = _listed(table, line, faults)
        if (one.name, one.file) in listed:
            thing, got = f"channel {one.name}", "it again"
            faults.append(Fault(thing, "listed once", got, table.where(line), "Keep one row"))
        listed[one.name, one.file] = one
    raise_all(faults)
    return [one for one in listed.values() if one.role != "ignore"]


def _listed(table: Table, line: int, faults: list[Fault]) -> Listed:
    """Read one row of the table of channels; what is wrong is added to the faults."""
    texts = {name: text_of(table, name, line) for name in _TEXTS}
    numbers = {name: table.numbers.get(name, np.full(line + 1, np.nan))[line] for name in _NUMBERS}
    where, role = table.where(line), texts["role"].lower() or "response"
    factor = 1.0 if np.isnan(numbers["sensitivity"]) else float(numbers["sensitivity"])
    unit = motion_unit(texts["unit"])
    unit = None if unit is None or unit.per or unit.amplitude else unit
    if role not in ROLES or not texts["channel"]:
        got, want = shown(f"{texts['channel']} {role}"), f"a name, and one of {', '.join(ROLES)}"
        faults.append(Fault("channel and role", want, got, where))
    if is_none(texts["unit"]) if role == "reference" else unit is None and role == "response":
        step = "Give the unit of the numbers times the sensitivity, e.g. m/s, Pa or V"
        want = "one of motion (m/s, mm/s, um, g), neither peak nor rms; of a reference any"
        faults.append(Fault("unit", want, shown(texts["unit"]) or "none", where, step))
    direction = unknown_vector()
    if role == "response" and texts["dir"]:
        with collect_faults(faults):
            direction = direction_of(texts["dir"], where, "dir")
    row = Row(
        plain_name(texts["point"]) or "1", np.empty(0), np.empty(0, dtype=complex), unit or MotionUnit(),
        texts["body"], texts["run"], direction=direction, where=where,
        position_m=1e-3 * np.array([numbers[name] for name in POSITION]),
    )  # fmt: skip
    per = SI_UNITS[unit.order] if unit else plain(texts["unit"])
    return Listed(texts["channel"], role, texts["file"], factor * (unit.scale if unit else 1.0), per, row)


def _read_samples(path: Path, names: Sequence[str]) -> tuple[float, dict[str, Array]]:
    """Return the sampling rate, Hz, and the samples of the named channels.

    Raises
    ------
    StapeskitError
        A channel is missing (those found are listed) or has several rows, channels of several lengths, times
        that are not evenly spaced, no sampling rate, or samples that are no finite numbers or all alike.
    """
    arrays = {name.lower(): np.asarray(value) for name, value in _arrays(path, names).items()}
    held = {name: one for name, one in arrays.items() if one.dtype.kind in "fiu" and one.size}
    listed = list_some(held, 20) or "none"
    if missing := [name for name in names if name.lower() not in held]:
        want = f"in the file, which has {listed}"
        raise StapeskitError.of(f"channel {list_some(missing)}", want, "no such one", path.name, _ONE_ROW)
    samples = {name: held[name.lower()] for name in names}
    raise_all(
        Fault(
            f"the variable {name}", "one row of samples", " x ".join(map(str, one.shape)), path.name, _ONE_ROW
        )
        for name, one in samples.items()
        if max(one.shape, default=1) < one.size
    )
    samples = {name: one.reshape(-1).astype(float) for name, one in samples.items()}
    longest = max(map(len, samples.values()))
    if min(map(len, samples.values())) < max(longest, _SHORTEST):
        got = ", ".join(f"{name} {len(one)}" for name, one in samples.items())
        want, step = f"of one number of samples, {_SHORTEST} at least", "Resample them to one rate"
        raise StapeskitError.of("the channels", want, got, path.name, step)
    times = [held[name].reshape(-1).astype(float) for name in TIMES if np.size(held.get(name, [])) == longest]
    rates = [float(held[name].reshape(-1)[0]) for name in RATES if np.size(held.get(name, [])) == 1]
    rates = [*(_sampling_rate(time, path.name) for time in times[:1]), *rates]
    if not rates or not 0.0 < rates[0] <= HIGHEST_HZ:
        step, got = "Add sample_rate_hz (a number) or time_s (s, one a sample)", f"the variables {listed}"
        raise StapeskitError.of("the file", "with a positive sampling rate", got, path.name, step)
    if any(abs(other - rates[0]) > 1e-3 * rates[0] for other in rates):
        got = " and ".join(f"{rate:g} Hz" for rate in rates)
        raise StapeskitError.of("the sampling rate", "one", got, path.name, "Keep the right one")
    faults = []
    for name, one in samples.items():
        if np.any(bad := ~(np.abs(one) <= LARGEST)):
            got = f"{int(np.sum(bad))} others, the first at sample {int(np.argmax(bad)) + 1}"
            want, step = f"finite and below {LARGEST:g}", "Cut the record, or leave the channel out"
            faults.append(Fault(f"the samples of channel {name}", want, got, path.name, step))
        elif np.ptp(one) == 0.0:
            step = "Check that it was connected, or give it the role ignore"
            faults.append(Fault(f"channel {name}", "with a signal", "one value throughout", path.name, step))
    raise_all(faults)
    return rates[0], samples


def _arrays(path: Path, names: Sequence[str]) -> Mapping[str, Any]:
    """Return the variables of a file by their names."""
    with path.open("rb") as stream:
        head = stream.read(128)
    if head.startswith(b"PK\x03\x04"):
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    if head.startswith((b"MATLAB", b"\x89HDF\r\n\x1a\n")) or path.suffix.lower() == ".mat":
        return read_tree(path)
    table, faults = read_named(path, ["time_s", *(name.lower() for name in names)], (), texts=())
    raise_all(faults)
    return table.numbers


def _sampling_rate(time: Array, where: str) -> float:
    """Return the sampling rate, Hz, of evenly spaced times (sample,), s; others are refused."""
    count = len(time) - 1
    span = float(time[-1] - time[0])
    even = span > count / HIGHEST_HZ and np.all(np.isfinite(time))
    if not even or np.max(np.abs((time - time[0]) * count / span - np.arange(count + 1))) > _JITTER:
        want, step = "finite, ascending and evenly spaced, in s", "Resample to even times"
        raise StapeskitError.of("the times", want, "others", where, step)
    return count / span


def _is_clipped(samples: Array) -> bool:
    """Return whether samples (n,) stay at an extreme in three stretches or more, and not at rest."""
    low, high, middle = float(np.min(samples)), float(np.max(samples)), float(np.median(samples))
    for extreme in (low, high):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], samples == extreme, [0]])))
        long = np.diff(edges)[::2] >= _CLIPPED
        if abs(middle - extreme) > 0.01 * (high - low) and np.sum(long) >= _CLIPPED:
            return True
    return False
