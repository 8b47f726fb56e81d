"""Tests on repeats and levels of one excitation: trends, levels and outliers of gains and of shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.measurement import Take
from legacy.kinematics.repeats.contrast_sums import ContrastSums, Outliers, contrasts, energy_of
from legacy.kinematics.repeats.repeat_shapes import Shapes
from legacy.stapeskit.arrays import Array

SHAPE = ("shape_trend", "shape_level", "shape_outlier")
_COLLINEAR_SHARE: float = calibrated("repeats.collinear_share")


@dataclass(frozen=True)
class RepeatTest:
    """One question to the repeats.

    Attributes
    ----------
    name : str
        ``gain_trend``, ``phase_trend``, ``gain_outlier``, ``gain_level`` (of the gain of all channels),
        ``shape_trend``, ``shape_level``, ``shape_outlier``, ``shape_scatter`` (of the responses relative
        to each other).
    size : float
        Relative change: from the first to the last repeat, from the lowest to the highest level, or of the
        outlying take from the others; rad for the phase, the factor on the stated noise for the scatter.
    take : int
        The outlying take, else -1.
    share : float
        Part of all changes of shape that this one explains.
    """

    name: str
    p_value: float
    size: float
    take: int = -1
    share: float = 1.0


def regressors(takes: Sequence[Take]) -> tuple[Array | None, Array | None]:
    """Return the order in time and the log level (take,) of every take; None where it is one for all."""
    names = list(dict.fromkeys(take.repeat for take in takes))
    try:
        numbers = [float(name) for name in names]
        names = [name for _, name in sorted(zip(numbers, names, strict=True))]
    except ValueError:
        pass
    time = np.array([float(names.index(take.repeat)) for take in takes])
    level = np.log(np.array([take.level for take in takes]))
    varies = bool(np.all(np.isfinite(level))) and np.ptp(level) > 1e-6
    return (time if len(names) > 1 else None), (level if varies else None)


def gain_tests(shapes: Shapes, time: Array | None, level: Array | None) -> list[RepeatTest]:
    """Test the gains of all channels for a trend, for proportionality to the level, and for an outlier."""
    count = len(shapes.log_gain)
    if not np.any(shapes.clear):
        return []
    columns = [np.ones(count)] + ([] if level is None else [level])
    tests = []
    if time is not None and not _collinear(columns, time):
        design = np.column_stack([*columns, time])
        for name, values in (("gain_trend", shapes.log_gain), ("phase_trend", shapes.phase)):
            fit = _regression(design, values)
            if fit is not None:
                slope, sd, freedom = fit
                p = _two_sided(slope / sd, freedom) if sd > 0.0 else 1.0
                change = slope * np.ptp(time)
                tests.append(RepeatTest(name, p, float(np.expm1(change) if name[0] == "g" else change)))
    if level is not None:
        fit = _regression(np.column_stack([np.ones(count), level]), shapes.log_gain)
        if fit is not None:
            slope, sd, freedom = fit
            p = _two_sided((slope - 1.0) / sd, freedom) if sd > 0.0 else 1.0
            tests.append(RepeatTest("gain_level", p, slope - 1.0))
    outlier = _gain_outlier(np.column_stack(columns), shapes.log_gain)
    return tests if outlier is None else [*tests, outlier]


def _two_sided(t: float, freedom: int) -> float:
    """Return the probability of a larger |t|."""
    from scipy import special

    return float(2.0 * special.stdtr(freedom, -abs(t)))


def _regression(design: Array, values: Array) -> tuple[float, float, int] | None:
    """Return the last coefficient, its standard deviation, and the degrees of freedom; None without any."""
    freedom = len(values) - design.shape[1]
    if freedom < 1:
        return None
    coefficients, *_ = np.linalg.lstsq(design, values, rcond=None)
    residual = values - design @ coefficients
    inverse = np.linalg.inv(design.T @ design)
    return float(coefficients[-1]), float(np.sqrt(residual @ residual / freedom * inverse[-1, -1])), freedom


def _gain_outlier(design: Array, values: Array) -> RepeatTest | None:
    count, size = design.shape
    freedom = count - size - 1
    if freedom < 2:
        return None
    hat = design @ np.linalg.pinv(design)
    residual = values - hat @ values
    keep = 1.0 - np.diag(hat)
    good = keep > 1e-6
    total = float(residual @ residual)
    without = np.maximum(total - residual**2 / np.where(good, keep, 1.0), 1e-300) / freedom
    t = np.where(good, np.abs(residual) / np.sqrt(without * np.where(good, keep, 1.0)), 0.0)
    worst = int(np.argmax(t))
    p = min(1.0, count * _two_sided(t[worst], freedom)) if total > 0.0 else 1.0
    return RepeatTest("gain_outlier", p, float(np.expm1(residual[worst] / keep[worst])), worst)


def _collinear(columns: Sequence[Array], new: Array) -> bool:
    """Return whether a regressor hardly differs from a combination of others."""
    centred = new - new.mean()
    base = np.column_stack(columns)
    residual = centred - base @ np.linalg.lstsq(base, centred, rcond=None)[0]
    return bool(np.linalg.norm(residual) < _COLLINEAR_SHARE * np.linalg.norm(centred))


def shape_tests(shapes: Shapes, time: Array | None, level: Array | None, stated: bool) -> list[RepeatTest]:
    """Test the residuals of the takes from one common shape for trend, effect of level, outliers."""
    lines = shapes.clear
    if not np.any(lines):
        return []
    gain = shapes.gain[lines]
    count = gain.shape[1]
    freedom = float(np.sum(shapes.counts[lines] - 1))
    strength = float(np.sum(shapes.strength[lines]))
    ones = [np.ones(count)]
    steps = [] if level is None else [level]
    ways: list[tuple[str, Array, list[Array]]] = []
    if level is not None:
        ways.append(
            ("shape_level", level, [] if time is None or _collinear([*ones, level], time) else [time])
        )
    if time is not None and not _collinear([*ones, *steps], time):
        ways.append(("shape_trend", time, steps))
    sums = [ContrastSums() for _ in ways]
    outliers = Outliers(count, steps)
    whole = 0.0
    for part in shapes.clear_blocks():
        data, own = shapes.data(part), shapes.gain[part]
        residual = shapes.residual(part, data)
        whole += energy_of(residual)
        for (_, way, others), contrast in zip(ways, sums, strict=True):
            basis = contrasts(own, [*others, way])
            spanned = np.einsum("ftk,ftc->fkc", basis.conj(), data, optimize=True)
            remainder = np.einsum("ftk,fkc->ftc", basis, spanned, optimize=True)
            contrast.add(spanned[:, -1], np.subtract(residual, remainder, out=remainder))
        outliers.add(data, own, residual)
    energies, doubt = [], count * shapes.stack.doubt
    for (name, way, others), contrast in zip(ways, sums, strict=True):
        rest = freedom * (count - 2 - len(others))
        p, noise = contrast.compared(freedom, rest, stated, doubt)
        if p is not None:
            length = np.linalg.norm(gain * _subtract_projection(gain, [*others, way]), axis=1)
            lever = float(np.sqrt(np.mean(length**2))) / float(np.ptp(way))
            energies.append((RepeatTest(name, p, lever), contrast.energy, noise))
    worst = outliers.worst(freedom, doubt)
    if worst is not None:
        p, take, lever, energy, noise = worst
        energies.append((RepeatTest("shape_outlier", p, lever, take), energy, noise))
    noise = min((noise for _, _, noise in energies), default=0.0)
    whole -= freedom * (count - 1) * noise
    tests = []
    for test, energy, _ in energies:
        excess = max(energy - freedom * noise, 0.0)
        size = np.sqrt(excess / strength) / max(test.size, 1e-12)
        tests.append(replace(test, size=float(size), share=excess / max(whole, excess, 1e-300)))
    return tests


def _subtract_projection(gain: NDArray[np.complex128], columns: Sequence[Array]) -> Array:
    """Return the last column (take,) less its projection on a constant and the others."""
    base = np.column_stack([np.ones(len(columns[-1])), *columns[:-1]])
    weights = np.sqrt(np.mean(np.abs(gain) ** 2, axis=0))[:, None]
    fit = np.linalg.lstsq(base * weights, columns[-1] * weights[:, 0], rcond=None)[0]
    return np.asarray(columns[-1] - base @ fit)


def scatter_test(shapes: Shapes, stated: bool) -> RepeatTest | None:
    """Compare all changes of shape with the stated noise.

    Notes
    -----
    A noise that is itself estimated, with the relative variance v of its inverse, adds m^2 v to the variance
    2 m of the m squares of a channel and line: their sum is judged with degrees of freedom that are fewer by
    1 + v + m v / 2 (Satterthwaite 1946, doi:10.2307/3002019).
    """
    from scipy import special

    lines = shapes.clear
    if not stated or not np.any(lines):
        return None
    freedom = 2.0 * (shapes.gain.shape[1] - 1) * float(np.sum(shapes.counts[lines] - 1))
    energy = sum(energy_of(shapes.residual(part, shapes.data(part))) for part in shapes.clear_blocks())
    doubt = shapes.stack.doubt
    widen = 1.0 + doubt + (shapes.gain.shape[1] - 1) * doubt
    p = float(special.chdtrc(freedom / widen, energy / widen))
    return RepeatTest("shape_scatter", p, np.sqrt(energy / freedom))
