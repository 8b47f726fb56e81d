"""Tests on repeats and levels of one excitation: trends, levels and outliers of gains and of shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinematics.measurement import Take
from kinematics.takes.take_shapes import Shapes

Array = NDArray[np.float64]
SHAPE = ("shape_trend", "shape_level", "shape_outlier")
_COLLINEAR = 0.3
_CORRELATED_LINES = 3


@dataclass(frozen=True)
class RepeatTest:
    """One question to the repeats.

    Attributes
    ----------
    name : str
        ``gain_trend``, ``phase_trend``, ``gain_outlier``, ``gain_level`` (of the gain of all channels),
        ``shape_trend``, ``shape_level``, ``shape_outlier``, ``shape_scatter`` (of the responses relative
        to each other).
    p_value : float
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
    found, *_ = np.linalg.lstsq(design, values, rcond=None)
    left = values - design @ found
    inverse = np.linalg.inv(design.T @ design)
    return float(found[-1]), float(np.sqrt(left @ left / freedom * inverse[-1, -1])), freedom


def _gain_outlier(design: Array, values: Array) -> RepeatTest | None:
    count, size = design.shape
    freedom = count - size - 1
    if freedom < 2:
        return None
    hat = design @ np.linalg.pinv(design)
    left = values - hat @ values
    keep = 1.0 - np.diag(hat)
    good = keep > 1e-6
    total = float(left @ left)
    without = np.maximum(total - left**2 / np.where(good, keep, 1.0), 1e-300) / freedom
    t = np.where(good, np.abs(left) / np.sqrt(without * np.where(good, keep, 1.0)), 0.0)
    worst = int(np.argmax(t))
    p = min(1.0, count * _two_sided(t[worst], freedom)) if total > 0.0 else 1.0
    return RepeatTest("gain_outlier", p, float(np.expm1(left[worst] / keep[worst])), worst)


def _collinear(columns: Sequence[Array], new: Array) -> bool:
    """Tell whether a regressor hardly differs from a combination of others."""
    centred = new - new.mean()
    base = np.column_stack(columns)
    left = centred - base @ np.linalg.lstsq(base, centred, rcond=None)[0]
    return bool(np.linalg.norm(left) < _COLLINEAR * np.linalg.norm(centred))


def shape_tests(shapes: Shapes, time: Array | None, level: Array | None, stated: bool) -> list[RepeatTest]:
    """Test what the takes leave beside one shape for a trend, an effect of the level, and an outlier."""
    lines = shapes.clear
    if not np.any(lines):
        return []
    pick = slice(None) if np.all(lines) else lines
    data, gain = shapes.data[pick], shapes.gain[pick]
    count = data.shape[1]
    freedom = float(np.sum(shapes.counts[lines] - 1))
    strength = float(np.sum(shapes.strength[lines]))
    residual = shapes.residual[pick]
    ones = [np.ones(count)]
    steps = [] if level is None else [level]
    ways: list[tuple[str, Array, list[Array]]] = []
    if level is not None:
        ways.append(
            ("shape_level", level, [] if time is None or _collinear([*ones, level], time) else [time])
        )
    if time is not None and not _collinear([*ones, *steps], time):
        ways.append(("shape_trend", time, steps))
    energies = []
    for name, way, others in ways:
        basis = _contrasts(gain, [*others, way])
        spanned = np.einsum("ftk,ftc->fkc", basis.conj(), data, optimize=True)
        left = np.einsum("ftk,fkc->ftc", basis, spanned, optimize=True)
        np.subtract(residual, left, out=left)
        rest = freedom * (count - 1 - basis.shape[2])
        p, noise = _compared(spanned[:, -1:], left, freedom, rest, stated)
        if p is not None:
            length = np.linalg.norm(gain * _beside(gain, [*others, way]), axis=1)
            lever = float(np.sqrt(np.mean(length**2))) / float(np.ptp(way))
            energies.append((RepeatTest(name, p, lever), _energy(spanned[:, -1]), noise))
    energies += _shape_outlier(data, gain, residual, steps, freedom)
    noise = min((noise for _, _, noise in energies), default=0.0)
    whole = _energy(residual) - freedom * (count - 1) * noise
    tests = []
    for test, energy, _ in energies:
        excess = max(energy - freedom * noise, 0.0)
        size = np.sqrt(excess / strength) / max(test.size, 1e-12)
        tests.append(replace(test, size=float(size), share=excess / max(whole, excess, 1e-300)))
    return tests


def _energy(values: NDArray[np.complex128]) -> float:
    return float(np.vdot(values, values).real)


def _contrasts(gain: NDArray[np.complex128], columns: Sequence[Array]) -> NDArray[np.complex128]:
    """Return orthonormal contrasts over the takes, (freq, take, k), orthogonal to the gains."""
    design = np.stack([gain, *(gain * (column - column.mean()) for column in columns)], axis=2)
    return np.asarray(np.linalg.qr(design)[0][:, :, 1:])


def _beside(gain: NDArray[np.complex128], columns: Sequence[Array]) -> Array:
    """Return the last column (take,) less its projection on a constant and the others."""
    base = np.column_stack([np.ones(len(columns[-1])), *columns[:-1]])
    weights = np.sqrt(np.mean(np.abs(gain) ** 2, axis=0))[:, None]
    fit = np.linalg.lstsq(base * weights, columns[-1] * weights[:, 0], rcond=None)[0]
    return np.asarray(columns[-1] - base @ fit)


def _shape_outlier(
    data: NDArray[np.complex128],
    gain: NDArray[np.complex128],
    residual: NDArray[np.complex128],
    columns: Sequence[Array],
    freedom: float,
) -> list[tuple[RepeatTest, float, float]]:
    """Test each take against the others; return the most certain one, its energy and the noise beside it."""
    count = data.shape[1]
    taken = 1 + len(columns)
    if count - taken < 2:
        return []
    basis = _contrasts(gain, columns) if columns else np.zeros((*gain.shape, 0), dtype=complex)
    own = residual
    if columns:
        own = residual - np.einsum("ftk,fkc->ftc", basis, np.einsum("ftk,ftc->fkc", basis.conj(), data))
    span = np.concatenate([gain[:, :, None], basis], axis=2)
    best: list[tuple[RepeatTest, float, float]] = []
    for take in range(count):
        way = np.eye(count)[take][None] - np.einsum("ftk,fk->ft", span, span[:, take].conj())
        length = np.linalg.norm(way, axis=1, keepdims=True)
        if np.min(length) < 1e-6:
            continue
        way = way / length
        z = np.einsum("ft,ftc->fc", way.conj(), data, optimize=True)
        left = way[:, :, None] * z[:, None, :]
        np.subtract(own, left, out=left)
        p, noise = _compared(z[:, None, :], left, freedom, freedom * (count - taken - 1), False)
        if p is None:
            continue
        lever = float(np.mean(length[:, 0] * np.abs(gain[:, take])))
        found = (RepeatTest("shape_outlier", min(1.0, count * p), lever, take), _energy(z), noise)
        if not best or (p, -found[1]) < (best[0][0].p_value / count, -best[0][1]):
            best = [found]
    return best


def _compared(
    z: NDArray[np.complex128], left: NDArray[np.complex128], own: float, rest: float, stated: bool
) -> tuple[float | None, float]:
    """Return the p-value of a contrast's energy and the noise per complex value it was compared with.

    Parameters
    ----------
    z : ndarray, (freq, 1, channel), complex
    left : ndarray, (freq, take, channel), complex
        What remains beside it.
    own, rest : float
        Complex degrees of freedom of both.
    stated : bool
        The noise is known: 2 per complex value.
    """
    from scipy import special

    energy = float(np.sum(np.abs(z) ** 2))
    if rest < 1.0:
        if not stated:
            return None, 0.0
        return float(special.chdtrc(2.0 * own, energy)), 2.0
    noise = float(np.sum(np.abs(left) ** 2)) / rest
    if noise <= 0.0:
        return (1.0 if energy <= 0.0 else 0.0), 0.0
    unequal = _unequal(left, rest)
    widen = _correlation(left) * unequal
    ratio = energy / own / noise
    return float(special.fdtrc(2.0 * own / widen, 2.0 * rest / widen, ratio)), noise


def _unequal(left: NDArray[np.complex128], rest: float) -> float:
    """Return by what factor unequal noise lowers the degrees of freedom.

    Energies per channel and line are sums of exponentials over the takes; with e = sum |r|^2 over m takes
    of equal noise s, E[e^2] = s^2 m (m + 1), so sum s^2 is estimated without knowing any s.
    """
    energy = np.sum(np.abs(left) ** 2, axis=1)
    cells = max(int(np.count_nonzero(energy)), 1)
    m = max(rest / cells, 0.25)
    squares = float(np.sum(energy**2)) / (m * (m + 1.0)) * m**2
    return max(1.0, squares * cells / max(float(np.sum(energy)) ** 2, 1e-300))


def _correlation(left: NDArray[np.complex128]) -> float:
    """Return by what factor correlation between neighbouring lines lowers the degrees of freedom."""
    left = np.ascontiguousarray(left)
    size = left.real**2 + left.imag**2
    total, lines = float(np.sum(size)), len(left)
    factor = 1.0
    for lag in range(1, min(_CORRELATED_LINES, lines - 1) + 1):
        product = abs(complex(np.vdot(left[:-lag], left[lag:]))) ** 2
        chance = float(np.vdot(size[lag:], size[:-lag]))
        factor += 2.0 * max(product - chance, 0.0) / total**2
    return factor


def scatter_test(shapes: Shapes, stated: bool) -> RepeatTest | None:
    """Compare all changes of shape with the stated noise."""
    from scipy import special

    lines = shapes.clear
    if not stated or not np.any(lines):
        return None
    freedom = 2.0 * (shapes.data.shape[1] - 1) * float(np.sum(shapes.counts[lines] - 1))
    energy = float(np.sum(np.abs(shapes.residual[lines]) ** 2))
    return RepeatTest("shape_scatter", float(special.chdtrc(freedom, energy)), np.sqrt(energy / freedom))
