"""What shows that whole bodies are labelled wrongly: one passive ligament carries the structure.

Each body by itself moves rigidly then, and no residual shows anything. What is left is that the same matrices
join the two bodies in every run and at every line, and that a ligament gives no power. At low frequencies it
carries the structure along with its base, whatever its stiffness: there one body in rms, or in another range,
stands out against all degrees of freedom at once, with few lines as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.records.mass_record import MassRecord
from legacy.stapeskit.records.motion import RigidMotion
from legacy.stapeskit.records.motion_files import standard_deviation
from legacy.stapeskit.spatial import DOF_NAMES, dof_indices

Order = NDArray[np.intp]
# Share of the motion that one ligament of constant matrices leaves even of right data.
MODEL = 0.02
# Weighs rotations against translations: about half the length of a footplate.
LEVER_M = 1e-3
# Misfits, 1 of right labels: others are tried above BAD, and taken below GOOD and BETTER of the given.
BAD, GOOD, BETTER = 5.0, 2.0, 0.2
# Real values of a component beyond its unknowns in A, B and C. With 11 a wrong label is taken in 0.2 % of
# 1200 motions that no ligament makes and in none of 800 right ones, with 7 in 0.5 %, with 3 in 2.7 %.
_SPARE = 11
# Power over that of noise from which a motion counts as one.
_MOVES = 4.0
# Lines of which the misfit is made: they bound the time.
_LINES = 200
# Relative error of M and of the frame that the sine of a lag may hold.
_MASS_ERROR = 0.015
# Standard deviations, and share of the lines, by which a lead of the structure is believed.
_STRONG, _SHARE = 6.0, 0.6
# The share of the lines that are the lowest, and a mean cosine there that no following body has.
_LOW, _OPPOSED = 0.15, -0.5
# Undamped resonances of a stapes on its ligament of which the likeliest counts: those of the paper lie from
# 1.7 to 3.9 kHz; the lowest leaves room for a soft ligament, the highest for a stiff one.
_RESONANCES_HZ = (400.0, 800.0, 1600.0, 3200.0)
# Standard deviations of what is not known: viscous loss (twice the damping ratio, at the resonance),
# hysteretic loss, and the errors of positions, beams and gains of either body relative to its motion.
_VISCOUS, _HYSTERETIC, _GEOMETRY = 1.0, 0.1, 0.05
# Lines of each run that are compared: more tell no more of a size that errors of the geometry limit, while
# the noise of the motions, which are regressors as well, biases the fit of many. Of 32 simulated slips at 60
# lines 27 were named with 30, 30 with 20, 32 with 14 and with 10.
_COMPARED = 15
# Least power of a component, of that of the strongest: keeps what does not move solvable.
_LEAST = 1e-12
_TINY = 1e-300


@dataclass(frozen=True)
class Lag:
    """How the structure lags its base, which a passive ligament makes it do.

    Attributes
    ----------
    deviations : float
        Weighted mean of the sine of the lag over its standard deviation: negative when the structure leads.
    leading, sure : int
        Lines at which the structure leads, of those whose lag differs from zero by three standard deviations.
    low_cosine : float
        Mean cosine of the lag over the lowest lines: near 1 when the structure follows its base there.
    """

    deviations: float
    leading: int
    sure: int
    low_cosine: float

    @property
    def reversed(self) -> bool:
        """Whether the structure clearly leads its base."""
        return self.deviations < -_STRONG and self.leading >= _SHARE * max(self.sure, 1)

    @property
    def opposed(self) -> bool:
        """Whether the two bodies move against each other at the lowest lines as well."""
        return self.low_cosine < _OPPOSED


@dataclass(frozen=True)
class Pair:
    """The motion of two bodies, NaN where it was not measured, in the size of what was read.

    That is displacements, or these times a power of the frequency; one line's ligament does not mind.

    Attributes
    ----------
    structure, base : ndarray, (run, line, m), complex
    sd : ndarray, (run, 2, line, m)
        Of the structure and of the base.
    freq_hz : ndarray, (line,)
    mass : ndarray, (m, m)
        Weighs the degrees of freedom by their power; only the translations where M is not known.
    names, runs : tuple of str
        Of the structure and the base, and of the runs.
    unit_m : ndarray, (m,)
        Brings rotations to the size of translations.
    """

    structure: ComplexArray
    base: ComplexArray
    sd: Array
    freq_hz: Array
    mass: Array
    names: tuple[str, str]
    runs: tuple[str, ...]
    unit_m: Array

    @classmethod
    def of(
        cls,
        motion: RigidMotion,
        structure: str,
        base: str,
        mass: MassRecord | None = None,
        derivatives: int = 0,
    ) -> Pair | None:
        """Return the motion of two bodies, absolute or per unit of a reference; None unless both exist.

        ``derivatives`` is the number of time derivatives in what was measured.
        """
        if structure not in motion.bodies or base not in motion.bodies:
            return None
        both = [motion.bodies.index(structure), motion.bodies.index(base)]
        rate = motion.freq_hz[:, None] ** derivatives
        q = motion.q[:, both] * rate
        places = dof_indices(motion.dof)
        weight = np.diag([float(name in DOF_NAMES[:3]) for name in motion.dof])
        if mass is not None:
            weight = mass.mass_matrix.matrix[np.ix_(places, places)]
        sd = standard_deviation(motion)[:, both] * rate
        unit_m = np.where(np.array(places) < 3, 1.0, LEVER_M)
        return cls(q[:, 0], q[:, 1], sd, motion.freq_hz, weight, (structure, base), motion.runs, unit_m)

    def lines(self, structure: Order | slice, base: Order | slice) -> Pair:
        """Return the pair with lines of the structure beside others of the base."""
        sd = np.stack([self.sd[:, 0, structure], self.sd[:, 1, base]], axis=1)
        return replace(self, structure=self.structure[:, structure], base=self.base[:, base], sd=sd)

    def complete_lines(self) -> NDArray[np.intp]:
        """Return the lines at which both bodies are determined in all runs."""
        good = np.isfinite(self.structure.real) & np.isfinite(self.base.real)
        return np.flatnonzero(np.all(good, axis=(0, 2)))

    def misfit(self) -> float | None:
        """Return the mean squared misfit of one ligament to all runs and lines; None with too few lines.

        Notes
        -----
        With w^2 M q_s = (K (1 + i eta) + i w D) dq every component of dq = q_s - q_b is
        dq = w^2 A q_s - i w B dq - i C dq with the same real A, B and C at all lines and in all runs: a
        linear regression that needs no mass matrix; solved for q_s it is another, which noise spoils less
        when the ligament is soft. The better of both counts for each component. It holds for data that are
        both conjugated as well, with the opposite damping. Misfits count in units of the noise and of 2 % of
        the motion.
        """
        lines = self.complete_lines()
        if len(lines) > _LINES:
            start, step = (len(lines) - _LINES) // 2, len(lines) // _LINES
            lines = lines[start % step :: step]
        runs, _, size = self.structure.shape
        sd = self.sd[:, :, lines]
        if 2 * runs * len(lines) < 3 * size + _SPARE or not np.all(np.isfinite(sd)):
            return None
        s, b = self.structure[:, lines], self.base[:, lines]
        w, dq = 2.0 * np.pi * self.freq_hz[lines, None], s - b
        by_mass = _stack(w**2 * s, -1j * w * dq, -1j * dq)
        by_spring = _stack(dq / w**2, 1j * dq / w, 1j * dq / w**2)
        variance = 2.0 * sd**2
        of_dq, of_s = np.sum(variance, axis=1).reshape(-1, size), variance[:, 0].reshape(-1, size)
        moved = np.sqrt(0.5 * np.mean(np.abs(s) ** 2 + np.abs(b) ** 2, axis=(0, 1)))
        own = np.sqrt(np.mean(np.abs(s) ** 2, axis=(0, 1)))
        dq, s = dq.reshape(-1, size), s.reshape(-1, size)
        total = 0.0
        for row in range(size):
            misfit = _misfit(by_mass, dq[:, row], of_dq[:, row] + (MODEL * moved[row]) ** 2)
            # Noise would be explained by nothing as well: a base that hardly moves is no structure.
            if own[row] ** 2 > _MOVES * np.mean(of_s[:, row]):
                misfit = min(misfit, _misfit(by_spring, s[:, row], of_s[:, row] + (MODEL * own[row]) ** 2))
            total += misfit
        return total / max(dq.size - 1.5 * size * size, 1.0)

    def lag(self) -> Lag | None:
        """Return the lag of the structure behind its base; None with fewer than three lines.

        Notes
        -----
        With w^2 M q_s = (K + i w D) (q_s - q_b) the mean power that the base puts in is
        w^3 Im(q_s^H M q_b) / 2, never negative for a passive ligament. Conjugated data turn its sign. So does
        a body with the wrong sign, which then also moves against its base at low frequencies, where the
        ligament carries it along. Each line counts by the inverse of its noise variance and of 0.015^2, which
        stands for what M and the frame leave uncertain, and by the size of q_s - q_b: the lag comes of the
        losses that this causes.
        """
        weighted = self.structure @ self.mass
        product = np.sum(weighted.conj() * self.base, axis=-1)
        variance = np.sum((np.abs(weighted) * self.sd[:, 1]) ** 2, axis=-1)
        variance = variance + np.sum((np.abs(self.base @ self.mass) * self.sd[:, 0]) ** 2, axis=-1)
        good = np.isfinite(product) & np.isfinite(variance) & (variance > 0.0) & (np.abs(product) > 0.0)
        if np.sum(good) < 3:
            return None
        size = np.abs(product[good])
        unit, error = product[good] / size, np.sqrt(variance[good]) / size
        weight = 1.0 / (error**2 + _MASS_ERROR**2)
        strain = np.sum(weighted.conj() * (self.base - self.structure), axis=-1)[good]
        shape = np.minimum(np.abs(strain) / size, 1.0)
        deviations = float(np.sum(weight * shape * unit.imag) / np.sqrt(np.sum(weight * shape**2)))
        sure = np.abs(unit.imag) > 3.0 * error
        freq = np.broadcast_to(self.freq_hz, good.shape)[good]
        low = freq <= np.quantile(freq, _LOW)
        cosine = float(np.sum((weight * unit.real)[low]) / np.sum(weight[low]))
        return Lag(deviations, int(np.sum(unit.imag[sure] < 0.0)), int(np.sum(sure)), cosine)


def joins_better(given: float, other: float) -> bool:
    """Return whether a ligament that explains little of the data as given explains them in another way."""
    return given > BAD and other < min(GOOD, BETTER * given)


def _stack(*parts: ComplexArray) -> Array:
    """Return regressors (2 n, k), real parts above imaginary ones, each of unit length."""
    columns = np.concatenate(parts, axis=-1)
    columns = columns.reshape(-1, columns.shape[-1])
    both = np.vstack([columns.real, columns.imag])
    return np.asarray(both / np.maximum(np.linalg.norm(both, axis=0), 1e-300))


def _misfit(columns: Array, target: ComplexArray, variance: Array) -> float:
    """Return the squared misfit of a regression over the variance (n,) of its complex targets."""
    root = np.tile(1.0 / np.sqrt(variance), 2)
    value = np.concatenate([target.real, target.imag]) * root
    solution = np.linalg.lstsq(columns * root[:, None], value, rcond=1e-10)[0]
    return float(np.sum((value - columns @ solution * root) ** 2))


def log_evidence(pair: Pair, related: bool = True) -> float:
    """Return the log probability density of the structure's motion, given that of its base.

    By one ligament that joins the two (``related``), or else by any constant matrix.

    Notes
    -----
    Of w^2 M q_s = (K (1 + i eta) + i w D) (q_s - q_b), each component of q_s - q_b is
    w^2 A q_s - i w B (q_s - q_b) - i C (q_s - q_b) + G q_b with real A = K^-1 M, B and C, and a complex G for
    what the geometry is off. All of them are normal with the stated sd and mean zero, A of (2 pi f)^-2 for a
    resonance f, of rotations over the lever: the evidence of a linear model (MacKay 1992,
    doi:10.1162/neco.1992.4.3.415). Noise of q_s counts (1 + (w / 2 pi f)^2) times, as the mass multiplies it.
    """
    lines = _compare(pair)
    return max(_evidence(pair, lines, resonance, related) for resonance in _RESONANCES_HZ)


def unrelated_evidence(pair: Pair) -> float:
    """Return the same when the two motions have nothing to do with each other.

    Each component is complex normal noise of its own size.
    """
    lines = _compare(pair)
    power = 0.5 * np.mean(np.abs(pair.structure[:, lines] * pair.unit_m) ** 2, axis=(0, 1))
    power = np.maximum(power, max(_LEAST * float(np.max(power)), _TINY))
    return float(-len(pair.runs) * len(lines) * np.sum(np.log(power) + 1.0))


def _compare(pair: Pair) -> NDArray[np.intp]:
    """Return the lines that are compared, evenly spread."""
    lines = pair.complete_lines()
    return lines[np.unique(np.linspace(0, len(lines) - 1, min(len(lines), _COMPARED)).round().astype(int))]


def _evidence(pair: Pair, lines: NDArray[np.intp], resonance_hz: float, related: bool) -> float:
    size = pair.structure.shape[-1]
    s = (pair.structure[:, lines] * pair.unit_m).reshape(-1, size)
    b = (pair.base[:, lines] * pair.unit_m).reshape(-1, size)
    sd = pair.sd[:, :, lines] * pair.unit_m
    ratio = np.tile(pair.freq_hz[lines] / resonance_hz, len(pair.runs))[:, None]
    power, of_base = np.mean(np.abs(s) ** 2, axis=0), np.mean(np.abs(b) ** 2, axis=0)
    # The noise of the base is scaled to the structure, so that its size does not depend on that of the base.
    share = power / np.maximum(of_base, _TINY)
    noise = (sd[:, 0] ** 2 + sd[:, 1] ** 2 * share).reshape(-1, size)
    noise = noise + 0.5 * MODEL**2 * np.mean(np.abs(s) ** 2, axis=1, keepdims=True)
    floor = max(_LEAST * float(np.max(power)), _TINY)
    variance = np.maximum(noise * (1.0 + ratio**2) ** 2, floor)
    dq, geometry = (s - b, _GEOMETRY * b) if related else (s, b)
    blocks = [ratio**2 * s, -1j * _VISCOUS * ratio * dq, -1j * _HYSTERETIC * dq, geometry, 1j * geometry]
    columns = np.hstack(blocks)
    root = 1.0 / np.sqrt(np.vstack([variance, variance])).T
    rows = np.vstack([columns.real, columns.imag]) * root[:, :, None]
    target = np.vstack([dq.real, dq.imag]).T * root
    gram = np.eye(rows.shape[2]) + rows.swapaxes(1, 2) @ rows
    factor = np.linalg.cholesky(gram)
    explained = np.linalg.solve(factor, (rows.swapaxes(1, 2) @ target[:, :, None]))[:, :, 0]
    logs = np.sum(np.log(root)) - np.sum(np.log(np.diagonal(factor, axis1=1, axis2=2)))
    return float(logs - 0.5 * (np.sum(target**2) - np.sum(explained**2)))
