"""The one table that every reader returns: a row is one beam at one point in one run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from kinematics.measurement import QUANTITIES, direction_name
from kinematics.readers.units import SI_UNITS, MotionUnit
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, Place
from stapeskit.units import LARGEST
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

QUANTITY_OF_ORDER = tuple(QUANTITIES)
NOISE = ("sd", "coherence", "n_avg")
"""Numbers of a row beside its values; each may be there or not."""


def unknown_vector() -> Array:
    """Return three NaN: a position or direction that the file does not hold."""
    return np.full(3, np.nan)


def from_parts(real: Array, imaginary: Array) -> ComplexArray:
    """Return ``real + i imaginary``; a complex product would make NaN of infinite parts."""
    value = np.empty(np.shape(real), dtype=complex)
    value.real, value.imag = real, imaginary
    return value


def from_polar(magnitude: Array, phase: Array, turn: float) -> ComplexArray:
    """Return complex numbers of magnitudes and of phases in units of ``turn`` radians.

    A phase that is no angle, as an infinite one, makes an infinite value: it is refused, not missing.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        value = np.asarray(magnitude * np.exp(1j * turn * phase))
    return np.where(np.abs(phase) > LARGEST, np.inf, value)


@dataclass(frozen=True)
class Row:
    """What one beam read at one point in one run.

    Attributes
    ----------
    point, body, run, repeat : str
        Empty where the file does not say them.
    freq_hz : ndarray, (L,)
        In ``freq_unit`` and any order; when settled in Hz, ascending, positive, the same for all rows.
    value : ndarray, (L,), complex
        e^{+iwt}; NaN where missing.
    unit : MotionUnit or str
        Of value and sd, as the file writes it; when settled SI (and peak, where it is known).
    position_m, direction : ndarray, (3,)
        Position of the point; unit vector towards the laser head. NaN where the file does not hold them.
    sd : number or ndarray, (L,), or None
        Standard deviation of the real (= imaginary) part.
    coherence, n_avg : number or ndarray, (L,), or None
        Ordinary coherence, 0 to 1; number of averages.
    relative : bool
        ``sd`` is known up to one factor.
    averages : float
        Behind an ``sd`` that follows from coherence; 0 for another one.
    hidden : float
        Share of the values whose noise is below what the decimals of their coherence show.
    where, lines, source, file : Place or str, ndarray (L,) or None, str, str
        Place of the row, and of each of its values; column or variable, and file: for messages.
    """

    point: str
    freq_hz: Array
    value: ComplexArray
    unit: MotionUnit | str = field(default_factory=MotionUnit)
    body: str = ""
    run: str = ""
    repeat: str = ""
    position_m: Array = field(default_factory=unknown_vector)
    direction: Array = field(default_factory=unknown_vector)
    sd: Array | float | None = None
    coherence: Array | float | None = None
    n_avg: Array | float | None = None
    relative: bool = False
    averages: float = 0.0
    hidden: float = 0.0
    freq_unit: str = "Hz"
    where: Place | str = ""
    lines: Array | None = None
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


def matrix_of(rows: Sequence[Row], name: str) -> Array | None:
    """Return numbers of rows, (P, L), NaN where a row has none; None where no row has any."""
    parts = [getattr(row, name) for row in rows]
    if all(part is None for part in parts):
        return None
    lines = rows[0].freq_hz.shape
    return np.array([np.broadcast_to(np.nan if part is None else part, lines) for part in parts])


@dataclass(frozen=True)
class Recording:
    """What a vibrometer file holds: P rows, one a beam, point and run, on L common lines.

    Attributes
    ----------
    file : str
        Its name.
    rows : tuple of Row, (P,)
    statement : str
        What the file says about its coordinates and units.
    length_stated : bool
        Whether the file says in which unit positions are (else they were taken as metres).
    lacks : frozenset of str
        What the file does not say: ``beam``, ``amplitude`` (peak or rms), ``length_unit``, ``n_avg``.
    line_spread : float
        By what factor the variance of slowly varying sums over lines exceeds that of independent lines.
    faults : tuple of Fault
        What the reader found wrong; empty when settled.
    """

    file: str
    rows: tuple[Row, ...]
    notices: tuple[Notice, ...] = ()
    statement: str = ""
    length_stated: bool = True
    lacks: frozenset[str] = frozenset()
    line_spread: float = 1.0
    faults: tuple[Fault, ...] = ()

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
        return matrix_of(self.rows, "sd")

    @property
    def coherence(self) -> Array | None:
        """Ordinary coherence, (P, L), 0 to 1."""
        return matrix_of(self.rows, "coherence")

    @property
    def n_avg(self) -> Array | None:
        """Number of averages, (P, L)."""
        return matrix_of(self.rows, "n_avg")

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
        known = {"re": self.value.real, "im": self.value.imag}
        known |= {name: matrix for name in NOISE if (matrix := matrix_of(self.rows, name)) is not None}
        return pd.DataFrame(columns | {name: matrix.ravel() for name, matrix in known.items()})

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
