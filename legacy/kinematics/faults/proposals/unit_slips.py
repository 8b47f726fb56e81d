"""Units that do not fit the header: checks of orders of magnitude.

Each yields for what is wrong nothing that is relabelled, and what the sentence says of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.spatial import point_rows

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


Slip = tuple[None, Mapping[str, object]]


def velocities(measurement: Measurement) -> Iterator[Slip]:
    """Compare velocities and their stated noise with the motion of ears and the resolution of vibrometers.

    A factor that all readings have leaves no trace in them but their size.
    """
    names, sizes, noises = list[str](), list[float](), list[float]()
    rate = 2.0 * np.pi * measurement.freq_hz
    for body in measurement.bodies:
        speed = np.abs(_some(body, rate))
        if not len(speed):
            continue
        names.append(body.body)
        sizes.append(float(np.median(speed)))
        if body.sd is not None and not body.relative:
            step = max(1, body.displacement.size // _SAMPLE)
            spread = body.sd[:, :, ::step] * rate[::step]
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
    small, unit = size <= FASTEST, _QUANTITIES[min(measurement.order, 2)]
    finer = f"{'mun'[min(power, 3) - 1]}{unit}"
    if _LEAST_DB < size < _MOST_DB:
        finer = f"decibels or {finer}"
    noisy = f" with a noise of {noise:.2g} m/s, below that of any vibrometer" if small and quiet else ""
    yield (
        None,
        {
            "bodies": f"{'bodies' if len(names) > 1 else 'body'} {', '.join(names)}",
            "size": size,
            "acceleration": size * 2.0 * np.pi * float(np.median(measurement.freq_hz)),
            "noisy": noisy,
            "slowest": SLOWEST,
            "fastest": FASTEST,
            "factor": 10.0 ** (3 * power),
            "off": "small" if small else "large",
            "pair": f"{unit} under a header in {finer}" if small else f"{finer} under a header in {unit}",
        },
    )


def points(measurement: Measurement) -> Iterator[Slip]:
    """Look at the distances of the points of each body."""
    for body in measurement.bodies:
        places = np.unique(body.positions_mm, axis=0)
        size = float(np.max(np.ptp(places, axis=0)))
        if len(places) > 1 and not _NEAREST_MM < size < _FARTHEST_MM:
            unit = "m" if size <= _NEAREST_MM else "um"
            yield None, {"body": body.body, "size": size, "unit": unit}


def frequencies(measurement: Measurement) -> Iterator[Slip]:
    """Look whether the frequencies are those of hearing."""
    highest = float(measurement.freq_hz[-1])
    if highest > _MOST_HZ:
        found = "beyond hearing: the frequencies look a thousand times too large for their header"
        yield None, {"highest": highest, "found": found}
    if highest < _HIGHEST_HZ:
        found = "below hearing: the frequencies look like kHz under a header in Hz"
        yield None, {"highest": highest, "found": found}


def ratios(measurement: Measurement) -> Iterator[Slip]:
    """Compare the bodies with the first, line by line: a resonance makes a factor of ten, not of hundreds."""
    step = max(1, measurement.bodies[0].displacement.size // _SAMPLE)
    sizes = []
    for body in measurement.bodies:
        part = np.abs(body.displacement[:, :, ::step])
        measured = np.isfinite(part)
        count = np.maximum(np.sum(measured, axis=(0, 1)), 1)  # at lines without a reading the size is 0
        sizes.append(np.sqrt(np.sum(np.where(measured, part, 0.0) ** 2, axis=(0, 1)) / count))
    for body, size in zip(measurement.bodies[1:], sizes[1:], strict=True):
        both = (size > 0.0) & (sizes[0] > 0.0)
        ratio = float(np.median(size[both] / sizes[0][both])) if np.any(both) else 1.0
        if not 1.0 / _LARGEST_RATIO < ratio < _LARGEST_RATIO:
            yield None, {"body": body.body, "ratio": ratio, "first": measurement.bodies[0].body}


def phases(measurement: Measurement) -> Iterator[Slip]:
    """Look whether all phases lie within pi degrees."""
    if measurement.freq_hz[-1] < _WIDE_BAND * measurement.freq_hz[0]:
        return
    turn = (1j * 2.0 * np.pi * measurement.freq_hz) ** measurement.order
    for body in measurement.bodies:
        value = _some(body, turn / np.abs(turn))
        if len(value) < _LEAST_VALUES:
            continue
        phase = np.abs(np.rad2deg(np.angle(value)))
        if _LEAST_PHASE < float(np.max(phase)) <= np.pi * (1.0 + 1e-6) and np.median(phase) > _MIDDLE_PHASE:
            yield None, {"body": body.body}


def decibels(measurement: Measurement) -> Iterator[Slip]:
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
                shares = {"after": 100.0 * np.sqrt(after), "given": 100.0 * np.sqrt(as_given)}
                yield None, {"body": body.body, **shares}


def _not_rigid(value: NDArray[Any], basis: Array) -> float:
    """Return the median share of the energy of readings (channel, line) outside the span of a basis."""
    whole = np.maximum(np.sum(np.abs(value) ** 2, axis=0), np.finfo(float).tiny)
    inside = np.sum(np.abs(basis.T @ value) ** 2, axis=0)
    return float(np.median(np.maximum(1.0 - inside / whole, 0.0)))


def _some(body: BodyChannels, turn: NDArray[Any]) -> NDArray[np.complex128]:
    """Return finite readings that are not zero, of some lines of large data, times a factor (freq,)."""
    value = body.displacement
    step = max(1, value.size // _SAMPLE)
    part = value[:, :, ::step] * turn[::step]
    return np.asarray(part[np.isfinite(part) & (part != 0.0)])
