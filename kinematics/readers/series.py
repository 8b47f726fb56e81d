"""Read time series (CSV, NPZ, WAV, MATLAB, HDF5) as frequency responses by a table of channels.

Files: a CSV with a column ``time_s`` and one column a channel (``freq_hz`` is the set frequency of a stepped
sine); arrays of samples, or of rows x samples, with ``sample_rate_hz`` (``fs``) or ``time_s`` (``t``); WAV,
whose channels are named 1, 2, ... and scaled to full scale = 1.

The table of channels, one row a channel::

    channel, role, body, point, dir | dir_x, dir_y, dir_z, unit [, sensitivity] [, x_mm, y_mm, z_mm] [, run]
    [, file]

``role`` is ``response``, ``reference`` or ``ignore``. ``unit`` says what the numbers are (any unit for a
reference); ``sensitivity`` is the factor from the numbers to it, such as 0.005 for volts at 5 mm/s/V in m/s.
An empty ``point`` says that the rows of a two-dimensional variable are points 1, 2, ...; with a point they
are records of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kinematics.readers.facts import FileFacts, is_file
from kinematics.readers.gather import Row, recording_of
from kinematics.readers.recording import Recording
from kinematics.readers.series_tables import Listed, read_channels, read_steps, reference_of, table_of
from kinematics.signals.frf import Frf, periodic_frf, segment_for, welch_frf
from kinematics.signals.lock_in import Step, stepped_frf
from kinematics.signals.samples import sample_notices
from stapeskit.arrays import Array
from stapeskit.faults import Fault, StapeskitError, collect_faults, list_some, raise_all
from stapeskit.units import HIGHEST_HZ, LARGEST
from stapeskit.warnings import Notice

TIMES = ("time_s", "time", "t", "x")
RATES = ("sample_rate_hz", "sample_rate", "fs", "fs_hz")

_JITTER = 0.1  # difference of sampling times, in samples, that counts as rounding of written times
_SHORTEST = 16  # samples; shorter records hold no spectrum

Record = tuple[Array | None, Array]
"""Reference (sample,) or None, and responses (channel, sample)."""


@dataclass(frozen=True)
class Series:
    """The samples of a file by channel, (record, sample) each; set frequencies (sample,) of its steps."""

    file: str
    sample_rate_hz: float
    start_s: float
    channels: Mapping[str, Array]
    set_hz: Array | None = None


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
    if not responses:
        want, step = f"with a response of {path.name}", "Add a row, or leave the column file empty"
        raise StapeskitError.of("the table of channels", want, "none", facts.channels.name, step)
    reference = reference_of(listed, facts.reference_channel, facts.channels.name)
    names = [row.name for row in responses] + ([] if reference is None else [reference.name])
    series = read_series(path, list(dict.fromkeys(names)))
    rows: list[Row] = []
    groups, notices = _groups(series, responses, reference)
    spread = 1.0
    for group, records in groups:
        frf = _estimate(records, series, facts)
        low, high = facts.frf_band_hz or (0.0, np.inf)
        lines = (frf.freq_hz >= low) & (frf.freq_hz <= high)
        if not np.any(lines):
            want, step = "wide enough for at least one line", "Widen --frf-band, or record longer"
            raise StapeskitError.of("the band", want, "none", path.name, step)
        for k, one in enumerate(group):
            coherence = None if frf.coherence is None else frf.coherence[k, lines]
            n_avg = None if np.isnan(frf.n_avg) else frf.n_avg
            noise = (frf.sd[k, lines], coherence, n_avg, frf.common_sd[lines])
            rows.append(Row(one.channel, frf.freq_hz[lines], frf.value[k, lines], *noise))
        notices += frf.notices
        spread = max(spread, frf.line_spread)
    return recording_of(
        path.name,
        rows,
        notices=tuple(dict.fromkeys([*sample_notices(series.channels, path.name), *notices])),
        statement=f"time series at {series.sample_rate_hz:g} Hz",
        line_spread=spread,
        amplitude_stated=True,
        from_series=True,
    )


def read_series(path: Path, names: Sequence[str]) -> Series:
    """Read the named channels of a file.

    Raises
    ------
    StapeskitError
        A channel is missing (those found are listed), times are not evenly spaced, there is no sampling rate,
        or samples are no finite numbers.
    """
    flat = _flatten(_tree(path, names))
    low = {name.lower(): array for name, array in reversed(flat.items())}
    listed = list_some(flat, 20) or "none"
    missing = [name for name in names if name.lower() not in low]
    if missing:
        want = f"in the file, which has {listed}"
        raise StapeskitError.of(f"channel {list_some(missing)}", want, "no such one", path.name)
    matched = {name: flat.get(name, low[name.lower()]) for name in names}
    longest = max(max(array.shape, default=0) for array in matched.values())
    time = next((low[name].reshape(-1) for name in TIMES if name in low and low[name].size == longest), None)
    rate = next((float(low[name].flat[0]) for name in RATES if name in low and low[name].size == 1), np.nan)
    if time is not None:
        rate = sampling_rate(time.astype(float), path.name)
    elif not 0.0 < rate <= HIGHEST_HZ:
        step, got = "Add sample_rate_hz (a number) or time_s (s, one a sample)", f"the variables {listed}"
        raise StapeskitError.of("the file", "with a positive sampling rate", got, path.name, step)
    faults: list[Fault] = []
    channels: dict[str, Array] = {}
    for name, array in matched.items():
        with collect_faults(faults):
            channels[name] = _samples(array, f"{path.name}, {name}")
    raise_all(faults)
    start = 0.0 if time is None else float(time[0])
    return Series(path.name, rate, start, channels, low["freq_hz"].reshape(-1) if "freq_hz" in low else None)


def _tree(path: Path, names: Sequence[str]) -> Mapping[str, Any]:
    """Return what a file holds by name; of a table the wanted columns."""
    with path.open("rb") as stream:
        head = stream.read(1024)
    if head.startswith((b"RIFF", b"RIFX", b"RF64")):
        return _wav(path)
    if head.startswith(b"PK\x03\x04"):
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    if head.startswith(b"MATLAB") or b"\x89HDF\r\n\x1a\n" in head:
        from kinematics.readers.matlab import read_variables

        return read_variables(path)
    wanted = ["time_s", *(name.lower() for name in names)]
    table = table_of(path, wanted, [*wanted, "freq_hz"])
    raise_all(table.faults)
    return table.numbers


def _wav(path: Path) -> dict[str, Any]:
    from scipy.io import wavfile

    rate, data = wavfile.read(path)
    samples, zero, full = np.atleast_2d(data.T).astype(float), 0.0, 1.0
    if data.dtype.kind in "iu":  # unsigned bytes have their zero at 128
        full = 2.0 ** (8 * data.dtype.itemsize - 1)
        zero = full if data.dtype.kind == "u" else 0.0
    return {"sample_rate_hz": rate, **{str(k): (row - zero) / full for k, row in enumerate(samples, 1)}}


def _flatten(tree: Mapping[str, Any], start: str = "") -> dict[str, Array]:
    """Return the numbers in a tree under names with dots."""
    arrays: dict[str, Array] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            arrays |= _flatten(value, f"{start}{name}.")
        elif np.asarray(value).dtype.kind in "fiu" and np.size(value):
            arrays[start + name] = np.asarray(value)
    return arrays


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


def _samples(values: Array, where: str) -> Array:
    """Return records of samples; the longer side is time. Rows without any number are left as they are."""
    rows = np.atleast_2d(values.astype(float).squeeze())
    if rows.ndim > 2 or rows.size < _SHORTEST:
        want = f"samples, or rows x samples ({_SHORTEST} at least)"
        raise StapeskitError.of("a channel", want, f"shape {values.shape}", where)
    rows = rows if rows.shape[1] >= rows.shape[0] else rows.T
    bad = ~(np.abs(rows) <= LARGEST) & ~np.all(np.isnan(rows), axis=1)[:, None]
    if np.any(bad):
        row, sample = np.argwhere(bad)[0].tolist()
        got = f"{int(np.sum(bad))} others, the first in row {row + 1}, sample {sample + 1}"
        step = "Cut the record, or leave the channel out"
        raise StapeskitError.of("the samples", f"finite and below {LARGEST:g}", got, where, step)
    return rows


def _groups(
    series: Series, responses: Sequence[Listed], reference: Listed | None
) -> tuple[list[tuple[list[Listed], list[Record]]], list[Notice]]:
    """Return what was recorded together: channels with a point, and each row of channels without one."""
    lead = None if reference is None else series.channels[reference.name]
    fixed = [one for one in responses if one.channel.point or len(series.channels[one.name]) == 1]
    roving = [one for one in responses if one not in fixed]
    groups: list[tuple[list[Listed], list[Record]]] = []
    notices: list[Notice] = []
    for members in filter(None, (fixed, roving)):
        used = {one.name: series.channels[one.name] for one in members}
        shapes = {rows.shape for rows in used.values()}
        shapes |= set() if lead is None or len(lead) == 1 else {lead.shape}
        samples = {shape[1] for shape in shapes} | (set() if lead is None else {lead.shape[1]})
        if len(shapes) > 1 or len(samples) > 1:
            got = ", ".join(f"{name} {' x '.join(map(str, rows.shape))}" for name, rows in used.items())
            step = "Resample channels that were sampled at another rate"
            want = "of one number of records (or points) and samples"
            raise StapeskitError.of("the channels", want, got, series.file, step)
        count = next(iter(shapes))[0]
        for part in [range(count)] if members is fixed else [range(k, k + 1) for k in range(count)]:
            alive = [one for one in members if all(_moves(used[one.name][k]) for k in part)]
            if len(alive) < len(members):
                silent = list_some((one.name for one in members if one not in alive), 6)
                text = (
                    f"{silent} of {series.file} hold one value throughout (a missing point) and are left out."
                )
                notices.append(Notice("zero_rows", text))
            if alive:
                point = "1" if members is fixed else str(part[0] + 1)
                per = "" if reference is None else reference.per
                named = [
                    replace(one, channel=replace(one.channel, point=one.channel.point or point, per=per))
                    for one in alive
                ]
                leads = None if reference is None or lead is None else lead * reference.scale
                records = [
                    (
                        None if leads is None else leads[k % len(leads)],
                        np.array([used[one.name][k] * one.scale for one in alive]),
                    )
                    for k in part
                ]
                groups.append((named, records))
    if not groups:
        step = "Check that the channels were connected"
        raise StapeskitError.of("the responses", "with a signal", "one value in all", series.file, step)
    return groups, notices


def _moves(row: Array) -> bool:
    return bool(np.all(np.isfinite(row)) and np.any(row != row[0]))


def _estimate(records: Sequence[Record], series: Series, facts: FileFacts) -> Frf:
    """Estimate responses as the excitation is: steps, a period, or segments of anything else."""
    rate = series.sample_rate_hz
    if facts.steps is not None or series.set_hz is not None:
        stretches = _set_frequencies(series) if facts.steps is None else read_steps(facts.steps)
        steps = [step for record in records for step in _steps(record, stretches, series)]
        return stepped_frf(steps, rate, facts.settle, series.file)
    pairs = [(lead, signals) for lead, signals in records if lead is not None]
    if not pairs:
        step = "Give a channel the role reference, e.g. the generator or a microphone"
        raise StapeskitError.of("the table of channels", "with a reference", "none", series.file, step)
    if facts.period_s is not None:
        return periodic_frf(pairs, rate, facts.period_s, series.file)
    shortest = min(len(lead) for lead, _ in pairs)
    segment = segment_for(shortest, max(3, -(-facts.averages // len(pairs))))
    return welch_frf(pairs, rate, segment, series.file)


def _set_frequencies(series: Series) -> list[tuple[float, float, float]]:
    """Return start and stop, s, and frequency, Hz, of the steps at which the generator was set."""
    set_hz = np.zeros(0) if series.set_hz is None else series.set_hz.astype(float)
    edges = [0, *(np.flatnonzero(np.diff(set_hz)) + 1).tolist(), len(set_hz)]
    seconds = series.start_s + np.array(edges) / series.sample_rate_hz
    stretches = zip(seconds[:-1].tolist(), seconds[1:].tolist(), edges[:-1], strict=True)
    return [(start, stop, float(set_hz[at])) for start, stop, at in stretches if set_hz[at] > 0.0]


def _steps(record: Record, stretches: Sequence[tuple[float, float, float]], series: Series) -> list[Step]:
    """Cut a record into its steps (start and stop, s; frequency, Hz)."""
    (lead, signals), rate = record, series.sample_rate_hz
    count, steps, outside = signals.shape[1], list[Step](), list[str]()
    for start, stop, freq in stretches:
        a, b = (round((second - series.start_s) * rate) for second in (start, stop))
        if not 0 <= a < b <= count + 1:
            outside.append(f"samples {a} to {b}")
        steps.append(Step(freq, None if lead is None else lead[a:b], signals[:, a:b]))
    if outside:
        want, step = f"within the record of {count} samples", "Correct the table of steps"
        raise StapeskitError.of("a step", want, list_some(outside), series.file, step)
    return steps
