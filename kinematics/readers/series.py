"""Read time series (CSV, NPZ, WAV, MATLAB, HDF5) as frequency responses by a table of channels.

Files: a CSV with a column ``time_s`` and one column a channel; arrays of samples by the names of their
channels with ``sample_rate_hz`` (``fs``) or ``time_s`` (``t``); WAV, whose channels are named 1, 2, ... and
scaled to full scale = 1. ``freq_hz`` is the set frequency of a stepped sine at each sample.

The table of channels, one row a channel::

    channel, role, body, point, dir, unit [, sensitivity] [, x_mm, y_mm, z_mm] [, run] [, file]

``role`` is ``response``, ``reference`` or ``ignore``; ``dir`` an axis, or dir_x, dir_y, dir_z. ``unit`` is
that of the numbers times ``sensitivity`` (any unit for a reference): 5 mm/s per volt is 0.005 and m/s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kinematics.readers.facts import FileFacts, direction_of, is_file
from kinematics.readers.gather import Row, recording_of
from kinematics.readers.points import cell_faults, require, text_of
from kinematics.readers.recording import SI_UNITS, Channel, Recording, unknown_vector
from kinematics.readers.text import plain_name, shown
from kinematics.readers.tree import read_tree
from kinematics.readers.units import MOTIONS, is_none, motion_unit, plain
from kinematics.signals.frf import Frf, periodic_frf, segment_for, welch_frf
from kinematics.signals.lock_in import Step, stepped_frf
from kinematics.signals.samples import sample_notices
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.units import HIGHEST_HZ, LARGEST
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from stapeskit.tables import Table

ROLES = ("response", "reference", "ignore")
TIMES = ("time_s", "time", "t", "x")
RATES = ("sample_rate_hz", "sample_rate", "fs", "fs_hz")

_NUMBERS = ("dir_x", "dir_y", "dir_z", "x_mm", "y_mm", "z_mm", "sensitivity")
_TEXTS = ("channel", "role", "body", "point", "dir", "unit", "run", "file")
_JITTER = 0.1  # difference of sampling times, in samples, that counts as rounding of written times
_ONE_ROW = "Save each channel under a name of its own, and each record to a file (column file of the table)"
_SHORTEST = 16  # samples; shorter records hold no spectrum


@dataclass(frozen=True)
class Listed:
    """One row of the table of channels: ``scale`` leads from the numbers of the file to SI, or to ``per``."""

    name: str
    role: str
    file: str
    scale: float
    per: str
    channel: Channel


def read(path: Path, facts: FileFacts) -> Recording:
    """Read the time series of one file as frequency responses.

    Raises
    ------
    StapeskitError
        No table of channels, a channel that is missing, no or several references, or what is wrong with the
        samples.
    """
    path = Path(path)
    if facts.channels is None:
        step = "Write a table with channel, role, body, point, dir and unit; see points2dof --help"
        raise StapeskitError.of("time series", "read with --channels FILE", "none", path.name, step)
    listed = [row for row in read_channels(facts.channels) if not row.file or is_file(row.file, path.name)]
    responses = [row for row in listed if row.role == "response"]
    references = [row for row in listed if row.role == "reference"]
    if not responses or len(references) > 1:
        want = f"with responses of {path.name} and at most one reference"
        got, step = f"{len(responses)} and {len(references)}", "Give the others the role ignore"
        raise StapeskitError.of("the table of channels", want, got, facts.channels.name, step)
    names = [row.name for row in (*responses, *references)]
    rate, samples, set_hz = _read_samples(path, names)
    notices = sample_notices({name: [one] for name, one in samples.items()}, path.name)
    alive = [row for row in responses if np.ptp(samples[row.name]) > 0.0]
    if silent := [row.name for row in responses if np.ptp(samples[row.name]) == 0.0]:
        text = f"{list_some(silent, 6)} of {path.name} hold one value throughout and are left out."
        notices.append(Notice("zero_rows", text))
    if not alive:
        step = "Check that the channels were connected"
        raise StapeskitError.of("the responses", "with a signal", "one value in all", path.name, step)
    lead = samples[references[0].name] * references[0].scale if references else None
    signals = np.array([samples[row.name] * row.scale for row in alive])
    frf = _estimate(lead, signals, rate, set_hz, facts, path.name)
    per = references[0].per if references else ""
    rows = [
        Row(
            replace(one.channel, per=per),
            frf.freq_hz,
            frf.value[k],
            sd=frf.sd[k],
            coherence=None if frf.coherence is None else frf.coherence[k],
            n_avg=None if np.isnan(frf.n_avg) else frf.n_avg,
            common_sd=frf.common_sd,
        )
        for k, one in enumerate(alive)
    ]
    return recording_of(
        path.name,
        rows,
        notices=(*notices, *frf.notices),
        statement=f"time series at {rate:g} Hz",
        line_spread=frf.line_spread,
        amplitude_stated=True,
    )


def read_channels(path: Path) -> list[Listed]:
    """Read a table of channels, without those to ignore.

    Raises
    ------
    StapeskitError
        A column is missing, a role, unit, sensitivity or direction cannot be read, or a channel is listed
        twice; all faults with their lines.
    """
    from stapeskit.tables import read_table

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, ("channel", "unit"), file)
        return set(_NUMBERS) & set(header), set(_TEXTS) & set(header)

    table = read_table(path, choose)
    faults = list(table.faults)
    if "sensitivity" in table.numbers:
        step = "Give the factor from the numbers of the file to unit"
        faults += cell_faults(table, "sensitivity", 1.0 / LARGEST, LARGEST, step)
    listed = [_listed(table, row, faults) for row in range(len(table))]
    keys = [(row.name, row.file) for row in listed]
    faults += [
        Fault(f"channel {key[0]}", "listed once", "it again", table.where(number), "Keep one row")
        for number, key in enumerate(keys)
        if key in keys[:number]
    ]
    raise_all(faults)
    return [row for row in listed if row.role != "ignore"]


def _listed(table: Table, row: int, faults: list[Fault]) -> Listed:
    """Read one row of the table of channels; what is wrong is added to the faults."""
    texts = {name: text_of(table, name, row) for name in _TEXTS}
    numbers = {name: table.numbers.get(name, np.full(row + 1, np.nan))[row] for name in _NUMBERS}
    where, role = table.where(row), texts["role"].lower() or "response"
    factor = 1.0 if np.isnan(numbers["sensitivity"]) else float(numbers["sensitivity"])
    unit = motion_unit(texts["unit"])
    unit = None if unit is None or unit.per else unit
    if role not in ROLES or not texts["channel"]:
        got, want = shown(f"{texts['channel']} {role}"), f"a name, and one of {', '.join(ROLES)}"
        faults.append(Fault("channel and role", want, got, where))
    if is_none(texts["unit"]) if role == "reference" else unit is None and role == "response":
        step = "Give the unit of the numbers times the sensitivity, e.g. m/s, Pa or V"
        want, got = f"one of {MOTIONS}; of a reference any", shown(texts["unit"]) or "none"
        faults.append(Fault("unit", want, got, where, step))
    direction = unknown_vector()
    if role == "response":
        direction = np.array([numbers[name] for name in _NUMBERS[:3]])
        with collect_faults(faults):
            direction = direction_of(texts["dir"], where, "dir") if texts["dir"] else direction
    channel = Channel(
        plain_name(texts["point"]) or "1",
        texts["body"],
        texts["run"],
        order=unit.order if unit else 1,
        direction=direction,
        where=where,
        position_m=1e-3 * np.array([numbers[name] for name in _NUMBERS[3:6]]),
    )
    scale = factor * (unit.scale if unit else 1.0)
    per = SI_UNITS[unit.order] if unit else plain(texts["unit"])
    return Listed(texts["channel"], role, texts["file"], scale, per, channel)


def _read_samples(path: Path, names: Sequence[str]) -> tuple[float, dict[str, Array], Array | None]:
    """Return sampling rate, Hz, samples of the named channels, and the set frequencies of a stepped sine.

    Raises
    ------
    StapeskitError
        A channel is missing (those found are listed) or has several rows, channels of several lengths, times
        that are not evenly spaced, no sampling rate, or samples that are no finite numbers.
    """
    arrays = {
        name.lower(): np.asarray(value)
        for name, value in reversed(list(_arrays(path, names).items()))
        if np.asarray(value).dtype.kind in "fiu" and np.size(value)
    }
    wanted = {"freq_hz", *(name.lower() for name in names)}
    faults = [
        Fault(
            f"the variable {name}", "one row of samples", " x ".join(map(str, one.shape)), path.name, _ONE_ROW
        )
        for name, one in arrays.items()
        if name in wanted and max(one.shape, default=1) < one.size
    ]
    raise_all(faults)
    held = {name: one.reshape(-1) for name, one in arrays.items()}
    listed = list_some(reversed(list(held)), 20) or "none"
    if missing := [name for name in names if name.lower() not in held]:
        want = f"in the file, which has {listed}"
        raise StapeskitError.of(f"channel {list_some(missing)}", want, "no such one", path.name)
    samples = {name: held[name.lower()].astype(float) for name in names}
    set_hz = held.get("freq_hz")
    counts = {name: len(one) for name, one in samples.items()}
    counts |= {} if set_hz is None else {"freq_hz": len(set_hz)}
    longest = max(counts.values())
    if len(set(counts.values())) > 1 or longest < _SHORTEST:
        got = ", ".join(f"{name} {count}" for name, count in counts.items())
        want, step = f"of one number of samples, {_SHORTEST} at least", "Resample them to one rate"
        raise StapeskitError.of("the channels", want, got, path.name, step)
    times = [held[name].astype(float) for name in TIMES if name in held and len(held[name]) == longest]
    rate = next((float(held[name][0]) for name in RATES if name in held and len(held[name]) == 1), np.nan)
    if times:
        rate = sampling_rate(times[0], path.name)
    elif not 0.0 < rate <= HIGHEST_HZ:
        step, got = "Add sample_rate_hz (a number) or time_s (s, one a sample)", f"the variables {listed}"
        raise StapeskitError.of("the file", "with a positive sampling rate", got, path.name, step)
    for name, one in samples.items():
        if np.any(bad := ~(np.abs(one) <= LARGEST)):
            got = f"{int(np.sum(bad))} others, the first at sample {int(np.argmax(bad)) + 1}"
            want, step = f"finite and below {LARGEST:g}", "Cut the record, or leave the channel out"
            faults.append(Fault(f"the samples of channel {name}", want, got, path.name, step))
    raise_all(faults)
    return rate, samples, set_hz


def _arrays(path: Path, names: Sequence[str]) -> Mapping[str, Any]:
    """Return the variables of a file by their names."""
    with path.open("rb") as stream:
        head = stream.read(128)
    if head[:4] in (b"RIFF", b"RIFX", b"RF64"):
        from scipy.io import wavfile

        rate, data = wavfile.read(path)
        zero, full = 0.0, 1.0
        if data.dtype.kind in "iu":  # unsigned bytes have their zero at 128
            full = 2.0 ** (8 * data.dtype.itemsize - 1)
            zero = full if data.dtype.kind == "u" else 0.0
        rows = (np.atleast_2d(data.T).astype(float) - zero) / full
        return {"sample_rate_hz": rate, **{str(k): row for k, row in enumerate(rows, 1)}}
    if head.startswith(b"PK\x03\x04"):
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    if head.startswith((b"MATLAB", b"\x89HDF\r\n\x1a\n")) or path.suffix.lower() == ".mat":
        return read_tree(path)
    from stapeskit.tables import read_table

    wanted = ["time_s", *(name.lower() for name in names)]

    def choose(header: Sequence[str], file: str) -> tuple[set[str], set[str]]:
        require(header, wanted, file)
        return {*wanted, "freq_hz"} & set(header), set()

    table = read_table(path, choose)
    raise_all(table.faults)
    return table.numbers


def sampling_rate(time: Array, where: str) -> float:
    """Return the sampling rate, Hz, of evenly spaced times (sample,), s.

    Raises
    ------
    StapeskitError
        Fewer than two times, or such that are not finite, do not ascend or are not evenly spaced.
    """
    span = float(time[-1] - time[0])
    if not (span > (len(time) - 1) / HIGHEST_HZ and np.all(np.isfinite(time))):
        raise StapeskitError.of("time_s", "at least two finite, ascending times in s", "others", where)
    step = span / (len(time) - 1)
    off = np.abs((time - time[0]) / step - np.arange(len(time)))
    if np.max(off) > _JITTER:
        got = f"{np.max(off):.3g} steps off at sample {np.argmax(off) + 1}"
        raise StapeskitError.of("time_s", "evenly spaced", got, where, "Resample to even times")
    return 1.0 / step


def _estimate(
    lead: Array | None, signals: Array, rate: float, set_hz: Array | None, facts: FileFacts, file: str
) -> Frf:
    """Estimate responses as the excitation is: steps, a period, or segments of anything else.

    ``lead`` (sample,) is the reference, ``signals`` (channel, sample) the responses.
    """
    if set_hz is not None:
        edges = [0, *(np.flatnonzero(np.diff(set_hz)) + 1).tolist(), len(set_hz)]
        steps = [
            Step(float(set_hz[a]), None if lead is None else lead[a:b], signals[:, a:b])
            for a, b in pairwise(edges)
            if set_hz[a] > 0.0
        ]
        return stepped_frf(steps, rate, file)
    if lead is None:
        step = "Give a channel the role reference, e.g. the generator or a microphone"
        raise StapeskitError.of("the table of channels", "with a reference", "none", file, step)
    if facts.period_s is not None:
        return periodic_frf([(lead, signals)], rate, facts.period_s, file)
    return welch_frf([(lead, signals)], rate, segment_for(len(lead), max(3, facts.averages)), file)
