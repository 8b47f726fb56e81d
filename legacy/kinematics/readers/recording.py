"""What every reader of a measuring system's file returns: one recording for each beam, point and run."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, Place, raise_all
from legacy.stapeskit.warnings import Notice

QUANTITIES = ("displacement", "velocity", "acceleration")


def unknown_vector() -> Array:
    """Return three NaN: a position or direction that is not in the file."""
    return np.full(3, np.nan)


def scaled(value: ComplexArray, factor: float) -> ComplexArray:
    """Return ``value * factor`` without a complex product, which would make NaN of infinite parts."""
    converted = np.empty(value.shape, dtype=complex)
    with np.errstate(over="ignore", invalid="ignore"):
        converted.real, converted.imag = value.real * factor, value.imag * factor
    return converted


def from_parts(real: ArrayLike, imaginary: ArrayLike) -> ComplexArray:
    """Return complex numbers of their parts; ``a + 1j * b`` would make NaN of infinite ones."""
    value = np.asarray(real).astype(complex)
    value.imag = imaginary
    return value


def from_polar(magnitude: Array, phase: Array, turn: float) -> ComplexArray:
    """Return complex numbers of magnitudes and of phases in units of ``turn`` radians."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(magnitude * np.exp(1j * turn * phase))


@dataclass(frozen=True)
class Recording:
    """What one beam at one point read in one run.

    Attributes
    ----------
    point : str
        Name or number of the point.
    freq_hz : ndarray, (freq,)
        Ascending; a DC line (0 Hz) may still be in it, it is dropped with a warning later.
    value : ndarray, (freq,), complex
        SI, peak amplitude, e^{+iwt}; NaN where missing.
    order : int
        0 displacement (m), 1 velocity (m/s), 2 acceleration (m/s2).
    where : Place
        For messages: ``Place(file, "line", (7,))``, ``Place(file, detail="channel x")``; faults that differ
        in the numbers only become one sentence.
    run : str
        The excitation; empty when the file does not say.
    body : str
        Empty when the file does not say.
    position_mm : ndarray, (3,)
        NaN when unknown.
    direction : ndarray, (3,)
        Unit vector towards the laser head; NaN when unknown.
    sd : ndarray, (freq,), or None
        Standard deviation of the real (= imaginary) part, in the unit of ``value``; None when unknown.
    coherence : ndarray, (freq,), or None
        Ordinary coherence, 0 to 1.
    n_avg : float or None
        Number of averages.
    relative : bool
        ``sd`` is known up to one factor only.
    per : str
        Unit of the reference when the value is a response per unit of it (``Pa``, ``V``, ``N``, ``m/s``);
        empty for an absolute amplitude.
    repeat : str
        Which repetition of the same run, empty with a single one.
    level : float
        Level of the excitation, in any unit; NaN when unknown.
    line_spread : float
        By what factor the variance of slowly varying sums over lines exceeds that of independent lines.
    common_sd : ndarray, (freq,), or None
        Relative standard deviation of the real (= imaginary) part of an error that all recordings made at
        the same time share: noise of their reference. It is not in ``sd``.

    Raises
    ------
    KinematicsError
        Shapes that do not match, an unknown order, frequencies that do not ascend, or a direction that is
        no unit vector.
    """

    point: str
    freq_hz: Array
    value: ComplexArray
    order: int
    where: Place
    run: str = ""
    body: str = ""
    position_mm: Array = field(default_factory=unknown_vector)
    direction: Array = field(default_factory=unknown_vector)
    sd: Array | None = None
    coherence: Array | None = None
    n_avg: float | None = None
    relative: bool = False
    per: str = ""
    repeat: str = ""
    level: float = float("nan")
    common_sd: Array | None = None
    line_spread: float = 1.0

    def __post_init__(self) -> None:
        faults = []
        count = self.freq_hz.shape
        for name in ("value", "sd", "coherence", "common_sd"):
            column = getattr(self, name)
            if column is not None and column.shape != count:
                faults.append(Fault(name, f"as long as the frequencies, {count}", column.shape, self.where))
        if self.order not in (0, 1, 2):
            step = "A vibrometer measures one of them"
            faults.append(
                Fault("the quantity", ", ".join(QUANTITIES), f"order {self.order}", self.where, step)
            )
        if self.freq_hz.ndim != 1 or not np.all(np.diff(self.freq_hz) > 0.0):
            faults.append(
                Fault("the frequencies", "ascending", "equal or descending ones", self.where, "Sort them")
            )
        if self.position_mm.shape != (3,) or self.direction.shape != (3,):
            faults.append(Fault("position and direction", "three numbers each", "others", self.where))
        elif np.all(np.isfinite(self.direction)) and not _is_unit(self.direction):
            got = ", ".join(f"{value:g}" for value in self.direction)
            step = "Divide the direction by its length"
            faults.append(Fault("the direction", "a unit vector (within 1e-3)", got, self.where, step))
        raise_all(KinematicsError, faults)


def _is_unit(direction: Array) -> bool:
    return bool(np.all(np.abs(direction) < 2.0)) and abs(float(np.linalg.norm(direction)) - 1.0) <= 1e-3


@dataclass(frozen=True)
class Recordings:
    """What one file, or one folder, holds.

    Attributes
    ----------
    frame_units : str
        What the file says about its coordinate system and units, for messages and provenance.
    file : str
        Its name, for messages and for choosing by name; filled in by `Format.read`.
    amplitude_stated : bool
        Whether the file says if amplitudes are peak or rms; if not, ``value`` holds its numbers as they are.
    length_stated : bool
        Whether the file says the unit of its positions; if not, they were taken as metres.
    from_series : bool
        Whether the values were estimated from time series.
    """

    recordings: tuple[Recording, ...]
    notices: tuple[Notice, ...] = ()
    frame_units: str = ""
    file: str = ""
    amplitude_stated: bool = False
    length_stated: bool = True
    from_series: bool = False
