"""The one table that every reader returns: a row is one beam at one point in one run."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from kinematics.measurement import QUANTITIES, direction_name
from kinematics.readers.coherence import last_digit, share_hidden, unexplained_power
from kinematics.readers.units import SI_UNITS, MotionUnit
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Place
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

QUANTITY_OF_ORDER = tuple(QUANTITIES)
VELOCITY = MotionUnit()


def unknown_vector() -> Array:
    """Return three NaN: a position or direction that the file does not hold."""
    return np.full(3, np.nan)


@dataclass(frozen=True)
class Row:
    """What one beam read at one point in one run.

    Attributes
    ----------
    point, body, run, repeat : str
        Empty where the file does not say them.
    freq_hz : ndarray, (L,)
        As the file has it; in a `Recording` ascending, positive, and the same for all rows.
    value : ndarray, (L,), complex
        e^{+iwt}; NaN where missing.
    unit : MotionUnit or str
        Of value and sd, as the file writes it; in a `Recording` SI (and peak, where the file says it).
    position_m, direction : ndarray, (3,)
        Position of the point; unit vector towards the laser head. NaN where the file does not hold them.
    sd : number or ndarray, (L,), or None
        Standard deviation of the real (= imaginary) part.
    coherence, n_avg : number or ndarray, (L,), or None
        Ordinary coherence, 0 to 1; number of averages.
    relative : bool
        ``sd`` is known up to one factor.
    hidden : float
        Share of the values whose noise is below what the decimals of their coherence show.
    where, source, file : Place or str
        Place, column or variable, and file, for messages.
    """

    point: str
    freq_hz: Array
    value: ComplexArray
    unit: MotionUnit | str = VELOCITY
    body: str = ""
    run: str = ""
    repeat: str = ""
    position_m: Array = field(default_factory=unknown_vector)
    direction: Array = field(default_factory=unknown_vector)
    sd: Array | float | None = None
    coherence: Array | float | None = None
    n_avg: Array | float | None = None
    relative: bool = False
    hidden: float = 0.0
    where: Place | str = ""
    source: str = ""
    file: str = ""

    @property
    def order(self) -> int:
        """0 displacement (m), 1 velocity (m/s), 2 acceleration (m/s2)."""
        return self.unit.order if isinstance(self.unit, MotionUnit) else 1

    @property
    def per(self) -> str:
        """Unit of the reference when the values are responses per unit of it (``Pa``, ``V``); else empty."""
        return self.unit.per if isinstance(self.unit, MotionUnit) else ""

    @property
    def name(self) -> str:
        """``body point (direction)`` for messages."""
        beam = "" if np.any(np.isnan(self.direction)) else f" ({direction_name(self.direction)})"
        return f"{self.body} {self.point}{beam}".strip()

    @cached_property
    def beam(self) -> tuple[str, tuple[float, ...]]:
        """Point and direction, in millionths, equal for beams that are one; zeros where it is not known."""
        return self.point, tuple((np.nan_to_num(np.round(1e6 * self.direction)) + 0.0).tolist())

    @property
    def key(self) -> tuple[object, ...]:
        """Names and beam by which a row is identified within a file."""
        return self.body, self.run, self.repeat, self.beam


@dataclass(frozen=True)
class Recording:
    """What a vibrometer file holds: P rows, one a beam, point and run, on L common lines.

    Attributes
    ----------
    file : str
        Its name.
    rows : tuple of Row, (P,)
    notices : tuple of Notice
    statement : str
        What the file says about its coordinates and units.
    amplitude_stated, length_stated : bool
        Whether the file says if amplitudes are peak or rms (else ``value`` holds its numbers as they are),
        and in which unit positions are (else they were taken as metres).
    line_spread : float
        By what factor the variance of slowly varying sums over lines exceeds that of independent lines.
    """

    file: str
    rows: tuple[Row, ...]
    notices: tuple[Notice, ...] = ()
    statement: str = ""
    amplitude_stated: bool = False
    length_stated: bool = True
    line_spread: float = 1.0

    def _matrix(self, name: str) -> Array | None:
        """Return numbers of all rows, (P, L), NaN where a row has none; None where no row has any."""
        parts = [getattr(row, name) for row in self.rows]
        if all(part is None for part in parts):
            return None
        lines = self.freq_hz.shape
        return np.array([np.broadcast_to(np.nan if part is None else part, lines) for part in parts])

    @property
    def freq_hz(self) -> Array:
        """Frequencies, (L,), Hz: ascending, positive."""
        return self.rows[0].freq_hz

    @property
    def value(self) -> ComplexArray:
        """Values, (P, L): m, m/s or m/s2, per unit of the reference where there is one; e^{+iwt}."""
        return np.array([row.value for row in self.rows])

    @property
    def sd(self) -> Array | None:
        """Standard deviation of the real (= imaginary) part, (P, L), in the unit of ``value``."""
        return self._matrix("sd")

    @property
    def coherence(self) -> Array | None:
        """Ordinary coherence, (P, L), 0 to 1."""
        return self._matrix("coherence")

    @property
    def n_avg(self) -> Array | None:
        """Number of averages, (P, L)."""
        return self._matrix("n_avg")

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the points, (P,)."""
        return tuple(row.point for row in self.rows)

    @property
    def points_m(self) -> Array:
        """Positions, (P, 3), m; NaN where the file holds none."""
        return np.array([row.position_m for row in self.rows])

    @property
    def directions(self) -> Array:
        """Unit vectors towards the laser head, (P, 3); NaN where the file holds none."""
        return np.array([row.direction for row in self.rows])

    @property
    def quantity(self) -> str:
        """``displacement``, ``velocity`` or ``acceleration``; several are joined by ``and``."""
        return " and ".join(QUANTITY_OF_ORDER[order] for order in sorted({row.order for row in self.rows}))

    @property
    def reference(self) -> str:
        """Unit of the reference that the values are responses to; empty for amplitudes."""
        return " and ".join(sorted({row.per for row in self.rows} - {""}))

    @property
    def units(self) -> str:
        """Unit of ``value``, such as ``m/s`` or ``(m/s)/N``."""
        kinds = {(SI_UNITS[row.order], row.per) for row in self.rows}
        return " and ".join(sorted(f"({unit})/{per}" if per else unit for unit, per in kinds))

    @property
    def frf(self) -> ComplexArray | None:
        """Responses per unit of the reference, (P, L); None where the file holds amplitudes."""
        return self.value if all(row.per for row in self.rows) else None

    @property
    def velocity(self) -> ComplexArray | None:
        """Velocity amplitudes, (P, L), m/s, also from displacement or acceleration; None for responses."""
        if any(row.per for row in self.rows):
            return None
        return np.array([row.value * (2j * np.pi * row.freq_hz) ** (1 - row.order) for row in self.rows])

    def with_noise(self) -> Recording:
        """Return the recording with the sd that follows from what its file states.

        Coherence without a number of averages and averages alone give an sd up to one factor (``relative``).
        The coherence of a single average is 1 by construction and says nothing; NaN where nothing is known.
        """
        coherence, counts = self.coherence, self.n_avg
        nothing = coherence is None and counts is None
        single = coherence is not None and counts is not None and not np.any(counts > 1.0)
        if self.sd is not None or nothing or single:
            return self
        averages = np.ones((len(self.rows), len(self.freq_hz))) if counts is None else counts
        sd, relative, hidden = 1.0 / np.sqrt(averages), True, [0.0] * len(self.rows)
        if coherence is not None:
            left = unexplained_power(coherence)
            if np.all(np.isnan(left)):
                return self
            # Bendat and Piersol 2010, Random Data, section 9.2: the sd of the real (= imaginary) part
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                sd = np.abs(self.value) * np.sqrt(left / (2.0 * averages * coherence))
            sd, relative = np.where(np.isfinite(sd), sd, np.nan), counts is None
            digit = last_digit(coherence)
            hidden = [share_hidden(own, digit) for own in coherence]
        rows = [
            replace(row, sd=own, relative=relative, hidden=share)
            for row, own, share in zip(self.rows, sd, hidden, strict=True)
        ]
        return replace(self, rows=tuple(rows))

    def to_frame(self) -> DataFrame:
        """Return a table with one row a beam and line, in SI; columns that the file lacks are left out."""
        import pandas as pd

        lines, columns = len(self.freq_hz), dict[str, object]()
        for name in ("body", "point", "run", "repeat"):
            texts = [getattr(row, name) for row in self.rows]
            if any(texts):
                columns[name] = np.repeat(np.array(texts, dtype=object), lines)
        for pattern, vectors in (("dir_{}", self.directions), ("{}_m", self.points_m)):
            if not np.all(np.isnan(vectors)):
                columns |= {pattern.format("xyz"[k]): np.repeat(vectors[:, k], lines) for k in range(3)}
        columns["freq_hz"] = np.tile(self.freq_hz, len(self.rows))
        known: dict[str, Array | None] = {"re": self.value.real, "im": self.value.imag}
        known |= {name: getattr(self, name) for name in ("sd", "coherence", "n_avg")}
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
        points = len({(row.body, row.point) for row in self.rows})
        noise = " with coherence" if self.coherence is not None else " with sd" if self.sd is not None else ""
        return (
            f"Recording({self.file}: {len(self.rows)} channels at {points} points, {len(self.freq_hz)} "
            f"lines, {self.freq_hz[0]:g} to {self.freq_hz[-1]:g} Hz, {self.quantity} in {self.units}{noise})"
        )
