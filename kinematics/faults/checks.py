"""Cheap checks of a whole measurement: rows of zeros, units, names of bodies.

Each check of `CHECKS` takes a measurement and yields warnings; what is wrong is named, nothing is changed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from kinematics.fit.beams import observability
from kinematics.measurement import BodyChannels, Measurement
from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import Fault, list_some
from stapeskit.spatial import dof_indices, point_rows
from stapeskit.warnings import Notice

_LOWEST_TOP_HZ, _HIGHEST_HZ = 40.0, 3e5  # a sweep that ends below is not of hearing; no ear hears beyond
SLOWEST, FASTEST = 1e-6, 20e-3
"""Velocity amplitudes of ears in experiments, m/s: 0.05 to 0.2 mm/s for each Pa at the stapes (Chien et al.
2009, doi:10.1016/j.heares.2008.11.011), at 50 to 130 dB (SPL)."""
_LARGEST_RATIO = 100.0  # between bodies: a resonance makes ten, in the median of a band not hundreds
LEAST_VALUES = 50  # fewer say too little of a distribution
_WIDE_BAND = 2.0  # last over first frequency from which damping turns the phase by more than pi degrees
_HALF_TURNS = ((np.pi, "radians"), (1.0, "multiples of pi"), (0.5, "cycles"))
_DECIBELS = (20.0, 200.0)
_SAMPLE = 100_000  # values looked at
_LEAST_FILLED = 5  # times that one value is there more often than any other: coarse digits repeat many


@dataclass(frozen=True)
class Screened:
    """A body with empty values as NaN, and for each run why a channel is empty: ``zeros`` or ``unused``."""

    body: BodyChannels
    unused: tuple[dict[int, str], ...]
    notices: tuple[Notice, ...]


def empty_faults(measurement: Measurement) -> list[Fault]:
    """List the bodies that hold nothing to fit: no value, or zeros throughout and no sd."""
    faults = []
    file = ", ".join(path.name for role, path in measurement.inputs.items() if role.startswith("ldv"))
    for body in measurement.bodies:
        thing = f"the values of body {body.body}"
        usable = (
            np.isfinite(body.value) if body.sd is None else np.isfinite(body.value) & np.isfinite(body.sd)
        )
        if not np.any(usable):
            step = "Check the export, or leave the rows of this body out"
            faults.append(Fault(thing, "numbers in at least one row", "empty or NaN cells", file, step))
        elif (body.sd is None or body.relative) and not np.any(body.value[usable]):
            step = "Give an sd column if the body stood still, or leave its rows out"
            faults.append(Fault(thing, "other than zero, or given with sd", "zeros throughout", file, step))
    return faults


def screen_zeros(body: BodyChannels, runs: tuple[str, ...], dof: tuple[str, ...]) -> Screened:
    """Set aside values that are exactly zero or fill gaps, and channels of one value while the body moves.

    Such a channel is believed when the other channels say that it moves so along its beam; all others are not
    when these cannot tell.
    """
    value = body.value
    drop = np.zeros(value.shape, dtype=bool)
    unused: list[dict[int, str]] = []
    texts: list[str] = []
    for run, name in enumerate(runs):
        where = f" in run {name}" if len(runs) > 1 else ""
        empty, dead = _silent(value[run])
        marks = dict.fromkeys(empty, "unused")
        if dead and len(dead) < len(value[run]) and _moves(body, run, dead, dof):
            drop[run, dead] = True
            marks |= dict.fromkeys(dead, "zeros")
            names = list_some((body.channel_name(c) for c in dead), most=6)
            reads = "one constant value" if np.any(np.nan_to_num(value[run, dead])) else "zero"
            texts.append(f"{names}{where} read {reads} throughout while the body moves")
        some = (value[run] == 0.0) & ~drop[run]
        some[dead] = False
        if np.any(some) and not np.any(np.all(some, axis=1)):
            drop[run] |= some
            texts.append(f"{int(np.sum(some))} single values of body {body.body}{where} are exactly zero")
        filler = _filler(value[run], dead)
        if filler is not None:
            some = value[run] == filler
            some[dead] = False
            drop[run] |= some
            texts.append(f"{int(np.sum(some))} values of body {body.body}{where} are exactly {filler:.6g}")
        unused.append(marks)
    if not texts:
        return Screened(body, tuple(unused), ())
    step = "these values were not used (missing points are often exported so)"
    body = replace(body, value=np.where(drop, np.nan, value))
    return Screened(body, tuple(unused), (Notice("zero_rows", f"{'; '.join(texts)}; {step}."),))


def _silent(value: ComplexArray) -> tuple[list[int], list[int]]:
    """Return the channels (c, L) without a value, and those with one value at all lines, such as zero."""
    empty, dead = [], []
    first, second = value[:, 0], value[:, min(1, value.shape[1] - 1)]
    doubtful = ~(np.isfinite(first) & np.isfinite(second) & (first != second))
    for channel in np.flatnonzero(doubtful).tolist():
        known = value[channel][np.isfinite(value[channel])]
        if not known.size:
            empty.append(channel)
        elif np.all(known == known[0]) and (known.size > 1 or known[0] == 0.0):
            dead.append(channel)
    return empty, dead


def _filler(value: ComplexArray, dead: list[int]) -> complex | None:
    """Return the value other than zero that fills gaps, as -9999: it alone is there again and again."""
    known = np.delete(value[:, :: max(1, value.size // _SAMPLE)], dead, axis=0)
    found, count = np.unique(known[np.isfinite(known) & (known != 0.0)], return_counts=True)
    order = np.argsort(count)[-2:]
    alone = len(order) == 2 and count[order[1]] >= _LEAST_FILLED * count[order[0]]
    return complex(found[order[1]]) if alone else None


def _moves(body: BodyChannels, run: int, dead: list[int], dof: tuple[str, ...]) -> bool:
    """Return whether the other channels see another motion along the beams of channels than these read."""
    whole = np.all(np.isfinite(body.value[run]), axis=1)
    others = np.setdiff1d(np.flatnonzero(whole), dead)
    arms, beams = body.arms_m, body.directions
    if len(others) < len(dof) or observability(arms[others], beams[others], dof)[-1] < 1e-3:
        return True
    rows = point_rows(arms, beams)[:, dof_indices(dof)]
    lines = np.any(body.value[run, others] != 0.0, axis=0)
    y, reads = body.value[run][others][:, lines], body.value[run][dead][:, lines]
    if y.shape[1] == 0:
        return False
    q = np.linalg.lstsq(rows[others], y, rcond=None)[0]
    left = np.sqrt(np.mean(np.abs(y - rows[others] @ q) ** 2))
    other = np.sqrt(np.nanmean(np.abs(rows[dead] @ q - reads) ** 2))
    return bool(other > 3.0 * left + 1e-9 * float(np.max(np.abs(y))))


def check_measurement(measurement: Measurement) -> list[Notice]:
    """Return the warnings of all checks."""
    return [notice for check in CHECKS for notice in check(measurement)]


def _some(body: BodyChannels) -> tuple[ComplexArray, slice]:
    """Return values (r, c, n) of some lines of large data, NaN where zero or missing, and these lines."""
    lines = slice(0, None, max(1, body.value.size // _SAMPLE))
    part = body.value[:, :, lines]
    return np.where(np.isfinite(part) & (part != 0.0), part, np.nan), lines


def _known(body: BodyChannels) -> ComplexArray:
    """Return the values of some lines that are neither zero nor missing, (n,)."""
    part, _ = _some(body)
    return np.asarray(part[np.isfinite(part)])


def _unit_slip(text: str, step: str) -> Notice:
    return Notice("unit_slip", f"{text}. {step}.")


def frequencies(measurement: Measurement) -> Iterator[Notice]:
    """Look whether the frequencies are those of hearing."""
    top = float(measurement.freq_hz[-1])
    if not _LOWEST_TOP_HZ <= top <= _HIGHEST_HZ:
        looks = "a thousand times too large" if top > _HIGHEST_HZ else "like kHz in a column of Hz"
        text = f"the highest frequency is {top:.4g} Hz: the frequencies look {looks}"
        yield _unit_slip(text, "Check their unit")


def velocities(measurement: Measurement) -> Iterator[Notice]:
    """Compare velocities with those of ears: a factor that all values have leaves no other trace."""
    rate = 2.0 * np.pi * measurement.freq_hz
    sizes = {}
    for body in measurement.bodies:
        part, lines = _some(body)
        speed = np.abs(part) * rate[lines] ** (1.0 - measurement.order)
        if np.any(np.isfinite(speed)):
            sizes[body.body] = float(np.nanmedian(speed))
    size = max(sizes.values(), default=np.sqrt(SLOWEST * FASTEST))
    if not SLOWEST < size < FASTEST:
        guess = "decibels, or " if _DECIBELS[0] < size < _DECIBELS[1] else ""
        text = (
            f"the velocities of {', '.join(sizes)} are {size:.2g} m/s in the median; ears move by "
            f"{SLOWEST:g} to {FASTEST:g} m/s in experiments: the values look like {guess}another unit"
        )
        yield _unit_slip(text, "Check the unit of the file")


def ratios(measurement: Measurement) -> Iterator[Notice]:
    """Compare the bodies with the first, line by line."""
    first, *others = measurement.bodies
    lines = slice(0, None, max(1, first.value.size // _SAMPLE))

    def sizes(body: BodyChannels) -> Array:
        square = np.abs(body.value[:, :, lines]) ** 2
        count = np.maximum(np.sum(np.isfinite(square), axis=(0, 1)), 1)
        return np.asarray(np.sqrt(np.nansum(square, axis=(0, 1)) / count))

    for body in others:
        size, of_first = sizes(body), sizes(first)
        both = (size > 0.0) & (of_first > 0.0)
        ratio = float(np.median(size[both] / of_first[both])) if np.any(both) else 1.0
        if not 1.0 / _LARGEST_RATIO < ratio < _LARGEST_RATIO:
            text = f"body {body.body} moves {ratio:.3g} times as much as {first.body}: one has another unit"
            yield _unit_slip(text, "Check the units of both")


def phases(measurement: Measurement) -> Iterator[Notice]:
    """Look whether no phase is larger than a turn in another unit, or all are 0, as of magnitudes alone.

    A unit is that of all bodies: the base of an ear may move in phase with the reference, or be it.
    """
    if measurement.freq_hz[-1] <= _WIDE_BAND * measurement.freq_hz[0]:
        return
    largest, count = 0.0, 0
    for body in measurement.bodies:
        known, (part, _) = _known(body), _some(body)
        turned = float(np.max(np.abs(np.rad2deg(np.angle(known))), initial=0.0))
        varied = np.any(np.abs(np.diff(part, axis=2)) > 0.0)  # else responses over the body itself
        if turned == 0.0 and known.size > LEAST_VALUES and varied:
            text = f"all values of body {body.body} are real and positive"
            yield _unit_slip(text, "They look like magnitudes without their phases")
        largest, count = max(largest, turned / (1.0 + 1e-6)), count + known.size
    for half_turn, unit in _HALF_TURNS if count > LEAST_VALUES else ():
        if 0.5 * half_turn < largest <= half_turn:
            text = f"all phases lie within {half_turn:.5g} degrees"
            yield _unit_slip(text, f"They look like {unit} in a column of degrees")


def decibels(measurement: Measurement) -> Iterator[Notice]:
    """Look whether amplitudes are all decibels: all within 20 to 200, in any unit of a header."""
    for body in measurement.bodies:
        size = np.abs(_known(body))
        for unit in (1.0, 1e-3, 1e-6, 1e-9) if size.size > LEAST_VALUES else ():
            low, high = float(np.min(size)) / unit, float(np.max(size)) / unit
            if _DECIBELS[0] < low and high < min(_DECIBELS[1], 3.0 * low):
                text = f"all amplitudes of body {body.body} lie between {low:.3g} and {high:.3g} of one unit"
                yield _unit_slip(f"{text}: they look like decibels", "Give them as linear amplitudes")


def exchanged_bodies(measurement: Measurement) -> Iterator[Notice]:
    """Look whether two bodies fit the positions of each other better than their own."""
    if len(measurement.bodies) != 2 or any(body.positions_m is None for body in measurement.bodies):
        return
    one, other = measurement.bodies
    if len(one.points) != len(other.points):
        return
    own = _misfit(one, one) + _misfit(other, other)
    if own > 0.0 and _misfit(one, other) + _misfit(other, one) < 0.1 * own:
        text = f"the values of {one.body} fit the points of {other.body}, and the reverse"
        yield Notice("bodies_exchanged", f"{text}: the names of the bodies are exchanged.")


def _misfit(values: BodyChannels, places: BodyChannels) -> float:
    """Return the share of the squares of values that no rigid motion at the places of a body makes."""
    part, _ = _some(values)
    y = part[0][:, np.all(np.isfinite(part[0]), axis=0)]
    if not y.size:
        return 0.0
    arms = places.arms_m - places.arms_m.mean(axis=0)
    rows = point_rows(arms / max(float(np.max(np.abs(arms))), 1e-12), places.directions)
    u, s, _ = np.linalg.svd(rows, full_matrices=False)
    u = u[:, s > 1e-6 * s[0]]
    return float(np.sum(np.abs(y - u @ (u.T @ y)) ** 2) / np.sum(np.abs(y) ** 2))


CHECKS: tuple[Callable[[Measurement], Iterator[Notice]], ...] = (
    frequencies, velocities, ratios, phases, decibels, exchanged_bodies,
)  # fmt: skip
"""All checks. A new one is one function and one entry."""
