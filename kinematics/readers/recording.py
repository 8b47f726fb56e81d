"""The one table that every reader returns: a row is one beam at one point in one run.

Shapes: P rows (channels), L frequency lines.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from kinematics.measurement import QUANTITIES, direction_name
from kinematics.readers.coherence import is_coarse, unexplained_power
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Place
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

QUANTITY_OF_ORDER = tuple(QUANTITIES)
SI_UNITS = ("m", "m/s", "m/s2")


def unknown_vector() -> Array:
    """Return three NaN: a position or direction that the file does not hold."""
    return np.full(3, np.nan)


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
    file : str
        Name of its file.
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
    file: str = ""

    @property
    def name(self) -> str:
        """``body point (direction)`` for messages."""
        beam = "" if np.any(np.isnan(self.direction)) else f" ({direction_name(self.direction)})"
        return f"{self.body} {self.point}{beam}".strip()

    @cached_property
    def beam_key(self) -> tuple[float, ...]:
        """The direction in millionths, equal for beams that are one; zeros where it is not known."""
        return tuple((np.nan_to_num(np.round(1e6 * self.direction)) + 0.0).tolist())

    @property
    def key(self) -> tuple[object, ...]:
        """Names and direction by which a channel is identified within a file."""
        return self.body, self.point, self.run, self.repeat, self.beam_key


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
        kinds = {(SI_UNITS[channel.order], channel.per) for channel in self.channels}
        return " and ".join(sorted(f"({unit})/{per}" if per else unit for unit, per in kinds))

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

    def with_noise(self) -> Recording:
        """Return the recording with the sd that follows from what its file states.

        Coherence without a number of averages, or with few decimals, and averages alone give an sd up to one
        factor (``relative``). The coherence of a single average is 1 by construction and says nothing; NaN
        where nothing is known.
        """
        coherence, counts = self.coherence, self.n_avg
        nothing = coherence is None and counts is None
        single = coherence is not None and counts is not None and not np.any(counts > 1.0)
        if self.sd is not None or nothing or single:
            return self
        averages = np.ones(self.value.shape) if counts is None else counts
        if coherence is None:
            return replace(self, sd=1.0 / np.sqrt(averages), relative=True)
        left = unexplained_power(coherence)
        if np.all(np.isnan(left)):
            return self
        # Bendat and Piersol 2010, Random Data, section 9.2: the sd of the real (= imaginary) part
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            sd = np.abs(self.value) * np.sqrt(left / (2.0 * averages * coherence))
        relative = counts is None or is_coarse(coherence)
        return replace(self, sd=np.where(np.isfinite(sd), sd, np.nan), relative=relative)

    def to_frame(self) -> DataFrame:
        """Return a table with one row a channel and line, in SI; columns that the file lacks are left out."""
        import pandas as pd

        count, lines = self.value.shape
        columns: dict[str, object] = {}
        for name in ("body", "point", "run", "repeat"):
            texts = [getattr(channel, name) for channel in self.channels]
            if any(texts):
                columns[name] = np.repeat(np.array(texts, dtype=object), lines)
        for pattern, vectors in (("dir_{}", self.directions), ("{}_m", self.points_m)):
            if not np.all(np.isnan(vectors)):
                columns |= {pattern.format("xyz"[k]): np.repeat(vectors[:, k], lines) for k in range(3)}
        columns |= {"freq_hz": np.tile(self.freq_hz, count)}
        columns |= {"re": self.value.real.ravel(), "im": self.value.imag.ravel()}
        known = {name: getattr(self, name) for name in ("sd", "coherence", "n_avg")}
        columns |= {name: matrix.ravel() for name, matrix in known.items() if matrix is not None}
        return pd.DataFrame(columns)

    def plot(self) -> Figure:
        """Draw amplitude and phase of every row over frequency."""
        from stapeskit.report.shown_figure import ShownFigure

        figure = ShownFigure(figsize=(7.0, 5.0), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True)
        above.loglog(self.freq_hz, np.abs(self.value).T, lw=0.6)
        below.semilogx(self.freq_hz, np.angle(self.value, deg=True).T, lw=0.6)
        above.set(ylabel=f"{self.quantity} ({self.units})", title=self.file)
        below.set(xlabel="frequency (Hz)", ylabel="phase (degrees)", yticks=range(-180, 181, 90))
        return figure

    def __repr__(self) -> str:
        points = len({(channel.body, channel.point) for channel in self.channels})
        noise = " with coherence" if self.coherence is not None else " with sd" if self.sd is not None else ""
        return (
            f"Recording({self.file}: {len(self.channels)} channels at {points} points, {len(self.freq_hz)} "
            f"lines, {self.freq_hz[0]:g} to {self.freq_hz[-1]:g} Hz, {self.quantity} in {self.units}{noise})"
        )
