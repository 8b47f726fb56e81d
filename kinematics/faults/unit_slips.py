"""Units that do not fit the header: checks of orders of magnitude, each a function and an entry of SLIPS."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from kinematics.measurement import BodyChannels, Measurement
from stapeskit.warnings import Notice

Array = NDArray[np.float64]
# Between points of a body of the middle ear, mm: no laser separates points nearer than its spot; no bone and
# no holder under a microscope is larger.
_NEAREST_MM, _FARTHEST_MM = 0.03, 300.0
# Highest frequency below which a sweep is not of hearing, Hz.
_HIGHEST_HZ = 40.0
# Displacement amplitudes, m: vibrometers resolve femtometres, and no ear moves by a tenth of a millimetre at
# audible frequencies.
_SMALLEST_M, _LARGEST_M = 1e-15, 2e-4
# The stapes stays no hundred times behind the bone, nor ahead of it, in the median of a band.
_LARGEST_RATIO = 100.0
# Over a factor of two in frequency damping turns the motion by more than pi degrees; radians never pass pi.
_LEAST_VALUES, _WIDE_BAND, _LEAST_PHASE, _MIDDLE_PHASE = 50, 2.0, 1.0, 0.3
_SAMPLE = 100_000


def unit_slips(measurement: Measurement) -> list[Notice]:
    """Return one warning for each unit that does not fit its header.

    Parameters
    ----------
    measurement : Measurement
        Positions in mm, frequencies in Hz, displacements in m, as the headers say.
    """
    return [Notice("unit_slip", text) for check in SLIPS for text in check(measurement)]


def _points(measurement: Measurement) -> Iterator[str]:
    for body in measurement.bodies:
        places = np.unique(body.positions_mm, axis=0)
        size = float(np.max(np.ptp(places, axis=0)))
        if len(places) < 2 or _NEAREST_MM < size < _FARTHEST_MM:
            continue
        unit = "m" if size <= _NEAREST_MM else "um"
        yield (
            f"the points of body {body.body} lie within {size:.3g} mm of each other: their coordinates look "
            f"like {unit} under a header in mm. Give them in mm, or correct the names of the columns."
        )


def _frequencies(measurement: Measurement) -> Iterator[str]:
    highest = float(measurement.freq_hz[-1])
    if highest < _HIGHEST_HZ:
        yield (
            f"the highest frequency is {highest:.4g} Hz, below hearing: the frequencies look like kHz under "
            "a header in Hz. Give them in Hz."
        )


def _amplitudes(measurement: Measurement) -> Iterator[str]:
    for body in measurement.bodies:
        size = np.abs(_some(body))
        if not len(size) or not np.max(size) > 0.0:
            continue
        middle = float(np.median(size[size > 0.0]))
        if not _SMALLEST_M < middle < _LARGEST_M:
            what = "large" if middle >= _LARGEST_M else "small"
            yield (
                f"body {body.body} moves by {middle:.2g} m (median displacement amplitude), too {what} for "
                "an ear: unless these are responses per unit of a reference, their unit is not that of the "
                "header. Check m, mm, um, nm, and displacement, velocity, acceleration in the names of "
                "the columns, and that the values are no decibels."
            )
    yield from _ratios(measurement)


def _ratios(measurement: Measurement) -> Iterator[str]:
    """Compare the bodies with the first, line by line: a resonance makes a factor of ten, not of hundreds."""
    if len(measurement.bodies) < 2:
        return
    step = max(1, measurement.bodies[0].displacement.size // _SAMPLE)
    sizes = []
    for body in measurement.bodies:
        part = np.abs(body.displacement[:, :, ::step])
        measured = np.isfinite(part)
        count = np.maximum(np.sum(measured, axis=(0, 1)), 1)  # at lines without a reading the size is 0
        sizes.append(np.sqrt(np.sum(np.where(measured, part, 0.0) ** 2, axis=(0, 1)) / count))
    for body, size in zip(measurement.bodies[1:], sizes[1:], strict=True):
        both = (size > 0.0) & (sizes[0] > 0.0)
        if not np.any(both):
            continue
        ratio = float(np.median(size[both] / sizes[0][both]))
        if not 1.0 / _LARGEST_RATIO < ratio < _LARGEST_RATIO:
            yield (
                f"body {body.body} moves {ratio:.3g} times as much as body {measurement.bodies[0].body} "
                "(median): their readings are hardly in the same unit. Check m, mm, um, nm in their rows or "
                "files."
            )


def _phases(measurement: Measurement) -> Iterator[str]:
    if measurement.freq_hz[-1] < _WIDE_BAND * measurement.freq_hz[0]:
        return
    turn = (1j * 2.0 * np.pi * measurement.freq_hz) ** measurement.order
    for body in measurement.bodies:
        value = _some(body, turn / np.abs(turn))
        if len(value) < _LEAST_VALUES:
            continue
        phase = np.abs(np.rad2deg(np.angle(value)))
        if _LEAST_PHASE < float(np.max(phase)) <= np.pi * (1.0 + 1e-6) and np.median(phase) > _MIDDLE_PHASE:
            yield (
                f"all phases of body {body.body} lie between -3.142 and 3.142 degrees: they look like "
                "radians under a header in degrees. Give them in degrees (times 57.296)."
            )


def _some(body: BodyChannels, turn: NDArray[np.complex128] | None = None) -> NDArray[np.complex128]:
    """Return finite readings that are not zero, of some lines of large data, times a factor (freq,)."""
    value = body.displacement
    step = max(1, value.size // _SAMPLE)
    part = value[:, :, ::step] * (1.0 if turn is None else turn[::step])
    return np.asarray(part[np.isfinite(part) & (part != 0.0)])


SLIPS: tuple[Callable[[Measurement], Iterator[str]], ...] = (_points, _frequencies, _amplitudes, _phases)
