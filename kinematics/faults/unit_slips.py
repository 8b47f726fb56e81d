"""Units that do not fit the header: checks of orders of magnitude, each a function and an entry of SLIPS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinematics.measurement import BodyChannels, Measurement
from stapeskit.arrays import Array
from stapeskit.spatial import point_rows
from stapeskit.warnings import Notice

# Between points of a body of the middle ear, mm: no laser separates points nearer than its spot; no bone and
# no holder under a microscope is larger.
_NEAREST_MM, _FARTHEST_MM = 0.03, 300.0
# Highest frequency below which a sweep is not of hearing, Hz.
_HIGHEST_HZ = 40.0
# Highest frequency that any ear hears, with a margin: bats and toothed whales reach 160 kHz.
_MOST_HZ = 3e5
# Velocity amplitudes of ears in experiments, m/s. The stapes moves by 0.05 to 0.2 mm/s for each Pa (measured
# in live and cadaver ears by Chien et al. 2009, doi:10.1016/j.heares.2008.11.011); sound of 50 dB (SPL) makes
# 1 um/s of that, 130 dB 20 mm/s, and a shaker that moves a whole sample by more does so with 13 g at 1 kHz.
SLOWEST, FASTEST = 1e-6, 20e-3
# Noise of a velocity, m/s: vibrometers of the best resolution have some 10 nm/s in 1 Hz, which 100 averages
# bring to 1 nm/s.
_LEAST_NOISE = 1e-9
_QUANTITIES = ("m", "m/s", "m/s^2")
# The stapes stays no hundred times behind the bone, nor ahead of it, in the median of a band.
_LARGEST_RATIO = 100.0
# Over a factor of two in frequency damping turns the motion by more than pi degrees; radians never pass pi.
_LEAST_VALUES, _WIDE_BAND, _LEAST_PHASE, _MIDDLE_PHASE = 50, 2.0, 1.0, 0.3
_SAMPLE = 100_000
# Decibels of what moves in an ear over 1 nm/s, 1 um/s or so; units of the header, in SI.
_LEAST_DB, _MOST_DB = 20.0, 200.0
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
# Lines on which a rigid motion is tried; shares of the energy that no rigid motion makes: of readings that
# are not rigid, and what the right unit leaves of that.
_TRIED_LINES, _NOT_RIGID, _CURED = 40, 1e-3, 0.1
# Motions that beams see with less than this share of the lever of the strongest count as unseen.
_SEEN = 1e-6


def unit_slips(measurement: Measurement) -> list[Notice]:
    """Return one warning for each unit that does not fit its header.

    Parameters
    ----------
    measurement : Measurement
        Positions in mm, frequencies in Hz, displacements in m, as the headers say.
    """
    slips = [Notice("unit_slip", text) for check in SLIPS for text in check(measurement)]
    # A wrong unit of frequencies, or of one body, makes velocities wrong too.
    return slips or [Notice("plausibility", text) for text in _velocities(measurement)]


def _velocities(measurement: Measurement) -> Iterator[str]:
    """Compare velocities and their stated noise with the motion of ears and the resolution of vibrometers.

    A factor that all readings have leaves no trace in them but their size.
    """
    names, sizes, noises = list[str](), list[float](), list[float]()
    for body in measurement.bodies:
        step = max(1, body.displacement.size // _SAMPLE)
        rate = 2.0 * np.pi * measurement.freq_hz[::step]
        speed = np.abs(body.displacement[:, :, ::step]) * rate
        speed = speed[np.isfinite(speed) & (speed > 0.0)]
        if not len(speed):
            continue
        names.append(body.body)
        sizes.append(float(np.median(speed)))
        if body.sd is not None and not body.relative:
            spread = body.sd[:, :, ::step] * rate
            noises.append(float(np.nanmedian(spread)) if np.any(np.isfinite(spread)) else 1.0)
    if not sizes:
        return
    size, noise = float(np.max(sizes)), min(noises, default=1.0)
    quiet = 0.0 < noise < _LEAST_NOISE
    if SLOWEST < size < FASTEST and not quiet:
        return
    # Bring the velocity nearest to the middle of what is plausible, by thousands.
    decades = np.log10(size / np.sqrt(SLOWEST * FASTEST))
    power = max(1, round(abs(decades) / 3.0))
    small = size <= FASTEST
    factor, unit = 10.0 ** (3 * power), _QUANTITIES[min(measurement.order, 2)]
    acceleration = size * 2.0 * np.pi * float(np.median(measurement.freq_hz))
    what = f"move by {size:.2g} m/s (median; acceleration {acceleration:.2g} m/s^2)"
    if small and quiet:
        what += f" with a noise of {noise:.2g} m/s, below that of any vibrometer"
    finer = f"{'mun'[min(power, 3) - 1]}{unit}"
    if _LEAST_DB < size < _MOST_DB:
        finer = f"decibels or {finer}"
    pair = f"{unit} under a header in {finer}" if small else f"{finer} under a header in {unit}"
    yield (
        f"{'bodies' if len(names) > 1 else 'body'} {', '.join(names)} {what}; ears in experiments move by "
        f"{SLOWEST:g} to {FASTEST:g} m/s. The values look {factor:g} times too "
        f"{'small' if small else 'large'} for their header, such as {pair}: check it, unless these are "
        "responses per unit of a reference."
    )


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
    if highest > _MOST_HZ:
        yield (
            f"the highest frequency is {highest:.4g} Hz, beyond hearing: the frequencies look a thousand "
            "times too large for their header. Give them in Hz."
        )
    if highest < _HIGHEST_HZ:
        yield (
            f"the highest frequency is {highest:.4g} Hz, below hearing: the frequencies look like kHz under "
            "a header in Hz. Give them in Hz."
        )


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


def _decibels(measurement: Measurement) -> Iterator[str]:
    """Compare the fit of a rigid motion to the readings as they are and as decibels."""
    step = max(1, len(measurement.freq_hz) // _TRIED_LINES)
    rate = (2j * np.pi * measurement.freq_hz[::step]) ** measurement.order
    for body in measurement.bodies:
        value = body.displacement[0, :, ::step] * rate
        value = value[:, np.all(np.isfinite(value) & (value != 0.0), axis=0)]
        arms = (body.positions_mm - np.mean(body.positions_mm, axis=0)) * 1e-3
        size = max(float(np.max(np.linalg.norm(arms, axis=1))), 1e-9)
        basis, strength, _ = np.linalg.svd(point_rows(arms / size, body.directions), full_matrices=False)
        basis = basis[:, strength > _SEEN * strength[0]]
        if not value.size or basis.shape[1] == len(value):
            continue
        as_given = _not_rigid(value, basis)
        amplitude = np.abs(value)
        for unit in _UNITS if as_given > _NOT_RIGID else ():
            level = amplitude / unit
            if not _LEAST_DB < np.median(level) < _MOST_DB:
                continue
            linear = 10.0 ** ((level - np.max(level)) / 20.0)
            after = _not_rigid(linear * np.exp(1j * np.angle(value)), basis)
            if after < _CURED * as_given:
                yield (
                    f"body {body.body} moves as a rigid body only when its amplitudes are taken as decibels "
                    f"({100.0 * np.sqrt(after):.2g} % of them are no rigid motion then, "
                    f"{100.0 * np.sqrt(as_given):.2g} % as given). Give amplitudes, 10^(dB/20) times the "
                    "reference."
                )


def _not_rigid(value: NDArray[Any], basis: Array) -> float:
    """Return the median share of the energy of readings (channel, line) outside the span of a basis."""
    whole = np.maximum(np.sum(np.abs(value) ** 2, axis=0), np.finfo(float).tiny)
    inside = np.sum(np.abs(basis.T @ value) ** 2, axis=0)
    return float(np.median(np.maximum(1.0 - inside / whole, 0.0)))


def _some(body: BodyChannels, turn: NDArray[np.complex128] | None = None) -> NDArray[np.complex128]:
    """Return finite readings that are not zero, of some lines of large data, times a factor (freq,)."""
    value = body.displacement
    step = max(1, value.size // _SAMPLE)
    part = value[:, :, ::step] * (1.0 if turn is None else turn[::step])
    return np.asarray(part[np.isfinite(part) & (part != 0.0)])


SLIPS: tuple[Callable[[Measurement], Iterator[str]], ...] = (
    _points,
    _frequencies,
    _ratios,
    _phases,
    _decibels,
)
