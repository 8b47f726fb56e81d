"""The one table that every reader returns: a row is one beam at one point in one run.

Shapes: P rows (channels), L frequency lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from kinematics.measurement import QUANTITIES, direction_name
from kinematics.readers.lines import check_filled, common_grid
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place, raise_all
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

QUANTITY_OF_ORDER = tuple(QUANTITIES)
SI_UNITS = ("m", "m/s", "m/s2")

_MATRICES = ("value", "sd", "coherence", "n_avg", "common_sd")


def unknown_vector() -> Array:
    """Return three NaN: a position or direction that the file does not hold."""
    return np.full(3, np.nan)


def scaled(value: ComplexArray, factor: float) -> ComplexArray:
    """Return ``value * factor`` without a complex product, which would make NaN of infinite parts."""
    result = np.empty(np.shape(value), dtype=complex)
    with np.errstate(over="ignore", invalid="ignore"):
        result.real, result.imag = np.real(value) * factor, np.imag(value) * factor
    return result


def from_polar(magnitude: Array, phase: Array, turn: float) -> ComplexArray:
    """Return complex numbers of magnitudes and of phases in units of ``turn`` radians."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(magnitude * np.exp(1j * turn * phase))


@dataclass(frozen=True)
class Channel:
    """What one row of a recording is.

    Attributes
    ----------
    point : str
        Name or number of the point.
    body, run, repeat : str
        Empty where the file does not say them.
    order : int
        0 displacement (m), 1 velocity (m/s), 2 acceleration (m/s2).
    per : str
        Unit of the reference when the values are responses per unit of it (``Pa``, ``V``, ``N``); empty for
        absolute amplitudes.
    position_m, direction : ndarray, (3,)
        Position of the point; unit vector towards the laser head. NaN where the file does not hold them.
    where : Place or str
        For messages.
    """

    point: str
    body: str = ""
    run: str = ""
    repeat: str = ""
    order: int = 1
    per: str = ""
    position_m: Array = field(default_factory=unknown_vector)
    direction: Array = field(default_factory=unknown_vector)
    where: Place | str = ""

    @property
    def name(self) -> str:
        """``body point (direction)`` for messages."""
        beam = "" if np.any(np.isnan(self.direction)) else f" ({direction_name(self.direction)})"
        return f"{self.body} {self.point}{beam}".strip()

    @cached_property
    def beam_key(self) -> tuple[float, ...]:
        """The direction in millionths, equal for beams that are one; zeros where it is not known."""
        return tuple((np.nan_to_num(np.round(1e6 * self.direction)) + 0.0).tolist())


@dataclass(frozen=True)
class Recording:
    """What a vibrometer file holds.

    Attributes
    ----------
    file : str
        Its name.
    freq_hz : ndarray, (L,)
        Ascending, positive.
    value : ndarray, (P, L), complex
        m, m/s or m/s2, per unit of the reference where there is one; peak, e^{+iwt}; NaN where missing.
    channels : tuple of Channel, (P,)
    sd : ndarray, (P, L), or None
        Standard deviation of the real (= imaginary) part, in the unit of ``value``.
    coherence : ndarray, (P, L), or None
        Ordinary coherence, 0 to 1.
    n_avg : ndarray, (P, L), or None
        Number of averages.
    relative : bool
        ``sd`` is known up to one factor.
    common_sd : ndarray, (P, L), or None
        Relative standard deviation of the real (= imaginary) part of an error that all rows recorded together
        share: noise of their reference. It is not in ``sd``.
    line_spread : float
        By what factor the variance of slowly varying sums over lines exceeds that of independent lines.
    statement : str
        What the file says about its coordinates and units.
    amplitude_stated, length_stated : bool
        Whether the file says if amplitudes are peak or rms (else ``value`` holds its numbers as they are),
        and in which unit positions are (else they were taken as metres).
    from_series : bool
        Whether the values were estimated from time series.

    Raises
    ------
    StapeskitError
        Shapes that do not match, a direction that is no unit vector, or frequencies that do not ascend.
    """

    file: str
    freq_hz: Array
    value: ComplexArray
    channels: tuple[Channel, ...]
    sd: Array | None = None
    coherence: Array | None = None
    n_avg: Array | None = None
    relative: bool = False
    common_sd: Array | None = None
    line_spread: float = 1.0
    notices: tuple[Notice, ...] = ()
    statement: str = ""
    amplitude_stated: bool = False
    length_stated: bool = True
    from_series: bool = False

    def __post_init__(self) -> None:
        faults = []
        want = (len(self.channels), len(self.freq_hz))
        for name in _MATRICES:
            matrix = getattr(self, name)
            if matrix is not None and matrix.shape != want:
                faults.append(Fault(f"the shape of {name}", str(want), matrix.shape, self.file))
        if np.any(self.freq_hz < 0.0) or np.any(np.diff(self.freq_hz) <= 0.0):
            faults.append(Fault("the frequencies", "ascending and not negative", "others", self.file))
        for channel in self.channels:
            length = float(np.sum(np.minimum(np.abs(channel.direction), 1e3) ** 2)) ** 0.5
            if abs(length - 1.0) > 1e-3:  # not so for NaN
                got, step = f"length {length:.4g}", "Divide the direction by its length"
                faults.append(Fault("a direction", "a unit vector (within 1e-3)", got, channel.where, step))
        raise_all(faults)

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the points, (P,)."""
        return tuple(channel.point for channel in self.channels)

    @property
    def points_m(self) -> Array:
        """Positions, (P, 3), m; NaN where the file holds none."""
        return np.array([channel.position_m for channel in self.channels]).reshape(-1, 3)

    @property
    def directions(self) -> Array:
        """Unit vectors towards the laser head, (P, 3); NaN where the file holds none."""
        return np.array([channel.direction for channel in self.channels]).reshape(-1, 3)

    @property
    def quantity(self) -> str:
        """``displacement``, ``velocity`` or ``acceleration``; several are joined by ``and``."""
        orders = sorted({channel.order for channel in self.channels})
        return " and ".join(QUANTITY_OF_ORDER[order] for order in orders)

    @property
    def reference(self) -> str:
        """Unit of the reference that the values are responses to; empty for amplitudes."""
        return " and ".join(sorted({channel.per for channel in self.channels} - {""}))

    @property
    def units(self) -> str:
        """Unit of ``value``, such as ``m/s`` or ``(m/s)/N``."""
        names = {
            f"({SI_UNITS[channel.order]})/{channel.per}" if channel.per else SI_UNITS[channel.order]
            for channel in self.channels
        }
        return " and ".join(sorted(names))

    @property
    def frf(self) -> ComplexArray | None:
        """Responses per unit of the reference, (P, L); None where the file holds amplitudes."""
        return self.value if all(channel.per for channel in self.channels) else None

    @property
    def velocity(self) -> ComplexArray | None:
        """Velocity amplitudes, (P, L), m/s, also from displacement or acceleration; None for responses."""
        if any(channel.per for channel in self.channels):
            return None
        missing = np.array([1 - channel.order for channel in self.channels])[:, None]
        return np.asarray(self.value * (2j * np.pi * self.freq_hz) ** missing)

    def to_frame(self) -> DataFrame:
        """Return a table with one row a channel and line, in SI; columns that the file lacks are left out."""
        import pandas as pd

        count, lines = self.value.shape
        columns: dict[str, object] = {}
        for name in ("body", "point", "run", "repeat"):
            texts = [getattr(channel, name) for channel in self.channels]
            if any(texts):
                columns[name] = np.repeat(np.array(texts, dtype=object), lines)
        for name, vectors in (("dir", self.directions), ("", self.points_m)):
            if not np.all(np.isnan(vectors)):
                for axis, letter in enumerate("xyz"):
                    label = f"{name}_{letter}" if name else f"{letter}_m"
                    columns[label] = np.repeat(vectors[:, axis], lines)
        columns["freq_hz"] = np.tile(self.freq_hz, count)
        columns["re"], columns["im"] = self.value.real.ravel(), self.value.imag.ravel()
        for name in ("sd", "coherence", "n_avg"):
            matrix = getattr(self, name)
            if matrix is not None:
                columns[name] = matrix.ravel()
        return pd.DataFrame(columns)

    def plot(self) -> Figure:
        """Draw amplitude and phase of every row over frequency."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(7.0, 5.0), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True)
        above.loglog(self.freq_hz, np.abs(self.value).T, lw=0.6)
        below.semilogx(self.freq_hz, np.angle(self.value, deg=True).T, lw=0.6)
        above.set(ylabel=f"{self.quantity} ({self.units})", title=self.file)
        below.set(xlabel="frequency (Hz)", ylabel="phase (degrees)", yticks=range(-180, 181, 90))
        return figure

    def __repr__(self) -> str:
        points = len(dict.fromkeys((channel.body, channel.point) for channel in self.channels))
        runs = len(dict.fromkeys((channel.run, channel.repeat) for channel in self.channels))
        span = f"{self.freq_hz[0]:g} to {self.freq_hz[-1]:g} Hz" if len(self.freq_hz) else "no line"
        noise = " with coherence" if self.coherence is not None else " with sd" if self.sd is not None else ""
        return (
            f"Recording({self.file}: {len(self.channels)} channels at {points} points, {runs} "
            f"run{'s' if runs > 1 else ''}, {len(self.freq_hz)} lines, {span}, {self.quantity} in "
            f"{self.units}{noise})"
        )


@dataclass(frozen=True)
class Row:
    """One channel with its own frequencies; the arrays are (L,) and as in `Recording`, averages a number."""

    channel: Channel
    freq_hz: Array
    value: ComplexArray
    sd: ArrayLike | None = None
    coherence: ArrayLike | None = None
    n_avg: ArrayLike | None = None
    common_sd: ArrayLike | None = None


def recording_of(file: str, rows: Sequence[Row], **facts: object) -> Recording:
    """Gather rows with frequencies of their own into one recording; a line at 0 Hz is dropped.

    Parameters
    ----------
    facts
        Other attributes of `Recording`.

    Raises
    ------
    StapeskitError
        There is no row; as `Recording`.
    """
    step = "Export the points with their spectra"
    raise_all(
        [Fault("the file", "with values of at least one point", "none", file, step)] if not rows else []
    )
    grid, places, notices = common_grid([row.freq_hz for row in rows])
    check_filled(len(rows), len(grid), sum(len(row.freq_hz) for row in rows), file)
    shape = (len(rows), len(grid))
    matrices: dict[str, Array] = {}
    for name in _MATRICES:
        parts = [getattr(row, name) for row in rows]
        if all(part is None for part in parts):
            continue
        matrix = np.full(shape, np.nan, dtype=complex if name == "value" else float)
        for number, part in enumerate(parts):
            if part is not None:
                matrix[number, places[number]] = part
        matrices[name] = matrix
    known: Mapping[str, object] = dict(facts)
    earlier = known.get("notices", ())
    channels = tuple(row.channel for row in rows)
    described = {**known, **matrices, "notices": (*earlier, *notices)}  # type: ignore[misc]
    return without_dc(Recording(file, grid, channels=channels, **described))  # type: ignore[arg-type]


def without_dc(recording: Recording) -> Recording:
    """Drop the line at 0 Hz, which holds no motion, with a notice.

    Raises
    ------
    StapeskitError
        There is no other line.
    """
    good = recording.freq_hz > 0.0
    if np.all(good):
        return recording
    if not np.any(good):
        step = "Export the lines above 0 Hz"
        raise_all([Fault("the frequencies", "above 0 Hz", "0 Hz alone", recording.file, step)])
    cut = {
        name: getattr(recording, name)[:, good] for name in _MATRICES if getattr(recording, name) is not None
    }
    text = f"the line at 0 Hz of {recording.file} holds no motion and was dropped."
    notices = (*recording.notices, Notice("dc_line", text))
    return replace(recording, freq_hz=recording.freq_hz[good], notices=notices, **cut)
