"""Motion and geometry together: the most probable axes, lasers, gains and positions from all lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.registration.geometry_model import GeometryModel, GeometryPriors
from legacy.kinematics.registration.prior_errors import compare_with_priors, shown
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.option_names import named
from legacy.stapeskit.spatial import dof_indices, point_rows
from legacy.stapeskit.warnings import Notice

Weights = Mapping[tuple[int, int], Array]
# Limit of steps of Gauss and Newton.
_ROUNDS = 12
# Relative difference by which noise may miss a product of channel and line and still be taken as one.
_SEPARABLE = 1e-6
# Multiplications; with more, lines are thinned.
_MOST_WORK = 4e10
_INFORMED_SHARE: float = calibrated("calibration.informed_share")
# Probability of a chi2 below which the priors and the data are reported as in conflict.
_UNLIKELY = 1e-3


@dataclass(frozen=True)
class Calibration:
    """The geometry that motion and priors agree on.

    Attributes
    ----------
    values : ndarray, (k,)
        Most probable parameters, rad, 1 and m; zero is the geometry as given.
    covariance : ndarray, (k, k)
        Of the parameters after the data, the motion at every line left free.
    measurement : Measurement
        With the new geometry.
    chi2, n_dof, p_value : float, int, float
        How far the data pull the geometry beyond what the priors let expect.
    fall : float
        By how much the sum of squared normalised residuals fell.
    """

    model: GeometryModel
    values: Array
    covariance: Array
    measurement: Measurement
    chi2: float
    n_dof: int
    p_value: float
    fall: float
    notices: tuple[Notice, ...] = ()

    @property
    def sd(self) -> Array:
        """Standard deviation (k,) of the parameters after the data."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which parameters (k,) the data inform: their sd fell below 0.9 of the prior's."""
        return np.asarray(self.sd < _INFORMED_SHARE * self.model.prior_sd)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters as shared errors: one source, as the data tie them together."""
        return tuple(f"calibration.{name}" for name in self.model.names)


@dataclass(frozen=True)
class _Block:
    """One body in one run: readings (channel, line) as given, m, and s = 1 / (sd sqrt 2), alike."""

    body: int
    y: ComplexArray
    s: Array
    lines: float


def calibrate(
    placed: Measurement, dof: Sequence[Sequence[str]], priors: GeometryPriors, weights: Weights
) -> Calibration:
    """Estimate the geometry of a measurement together with the motion of all bodies at all lines.

    Parameters
    ----------
    placed : Measurement
        In the footplate frame.
    dof : sequence of sequence of str
        By body: the degrees of freedom that are left free at every line.
    weights : mapping of (run, body) to ndarray, (channel, freq)
        1 / (2 sd^2), zero where a value is not used.

    Raises
    ------
    KinematicsError
        There is nothing to estimate: all priors are zero and no position has an sd.

    Notes
    -----
    Maximum a posteriori by Gauss-Newton with the motion projected out (variable projection: Golub and Pereyra
    1973, doi:10.1137/0710036). The covariance is the inverse of information plus prior; in the information
    the part of the estimated motion that is noise is subtracted. Shifts of all points of a body together,
    and turns of all positions together with all beams, change no residual whatever the motion is.
    """
    model = GeometryModel.of(placed, priors)
    if not model.names:
        raise KinematicsError.of(
            "{calibrate}",
            "used with something to estimate",
            "{axes_sd} 0, {beam_sd} 0, {gain_sd} 0 and no sd_mm of any point",
            next_step="Give at least one of them",
        )
    values = np.zeros(len(model.names))
    prior = 1.0 / model.prior_sd**2
    blocks = [
        block
        for run in range(len(placed.runs))
        for body in range(len(placed.bodies))
        if (block := _block(placed, run, body, weights[run, body], len(model.names))) is not None
    ]
    energy = _energy(model, blocks, dof, values)
    start, target = energy, energy
    for _ in range(_ROUNDS):
        information, score = _information(model, blocks, dof, values, noise=False)
        gradient = score - prior * values
        step = _solve(information + np.diag(prior), gradient)
        size = 1.0
        while size > 1e-3:
            trial = values + size * step
            energy = _energy(model, blocks, dof, trial)
            goal = energy + 0.5 * float(np.sum(prior * trial**2))
            if goal <= target + 0.5 * float(np.sum(prior * values**2)) + 1e-9 * abs(target):
                break
            size *= 0.5
        values, target = values + size * step, energy
        if np.max(np.abs(step) * np.sqrt(prior + np.diag(information))) < 1e-3:
            break
    information, _ = _information(model, blocks, dof, values, noise=True)
    covariance = _inverse(information + np.diag(prior))
    chi2, n_dof, p = compare_with_priors(values, covariance, model.prior_sd, np.eye(len(values)))
    calibration = Calibration(
        model, values, covariance, model.moved(values), chi2, n_dof, p, 2.0 * (start - target)
    )
    return replace(calibration, notices=_notices(calibration))


def _block(placed: Measurement, run: int, body: int, weights: Array, size: int) -> _Block | None:
    """Collect one body in one run, without loss in fewer lines where the noise allows it.

    Notes
    -----
    Where s is a product of one factor per channel and one per line, the whitened readings matter only
    through their products over lines: an orthogonal factorisation leaves as many lines as channels.
    """
    value = placed.bodies[body].displacement[run]
    live = np.any(weights > 0.0, axis=0)
    if not np.any(live):
        return None
    s = np.sqrt(weights[:, live])
    y = np.where(s > 0.0, np.nan_to_num(value[:, live]), 0.0)
    across = np.sqrt(np.mean(s**2, axis=1))
    along = np.sqrt(np.mean(s**2, axis=0))
    product = np.outer(across, along) / np.sqrt(np.mean(s**2))
    lines = float(y.shape[1])
    if np.max(np.abs(s - product)) <= _SEPARABLE * np.max(product):
        factor = along / np.sqrt(np.mean(along**2))
        whole = y * factor
        if whole.shape[1] > whole.shape[0]:
            whole = np.asarray(np.linalg.qr(whole.T)[1]).T
        return _Block(body, whole, np.repeat(across[:, None], whole.shape[1], axis=1), lines)
    work = y.shape[1] * len(y) * float(size) ** 2
    thin = max(1, int(np.ceil(work / _MOST_WORK)))
    return _Block(body, y[:, ::thin], s[:, ::thin], float(len(y[0, ::thin])))


def _rows(model: GeometryModel, body: int, values: Array, dof: Sequence[str]) -> Array:
    moved = model.body(body, values)
    gain = 1.0 + model.gains(body, values)
    rows = point_rows(moved.positions_mm * 1e-3, moved.directions)
    return np.asarray(gain[:, None] * rows[:, dof_indices(tuple(dof))])


def _fit(block: _Block, rows: Array) -> tuple[Array, ComplexArray, ComplexArray]:
    """Return orthonormal whitened columns (line, channel, m) or (channel, m), the residual, and coefficients.

    The coefficients (m, line) belong to the columns of ``rows`` divided by their lengths.
    """
    scale = np.linalg.norm(rows, axis=0)
    if np.array_equal(block.s[:, :1].repeat(block.s.shape[1], 1), block.s):
        q, r = np.linalg.qr(block.s[:, :1] * rows / scale)
        whole = block.s * block.y
        z = q.T @ whole
        return q, np.asarray(whole - q @ z), np.asarray(np.linalg.solve(r, z), dtype=complex)
    q, r = np.linalg.qr(block.s.T[:, :, None] * (rows / scale))
    whole = block.s * block.y
    z = np.einsum("fcm,cf->fm", q, whole)
    residual = np.asarray(whole - np.einsum("fcm,fm->cf", q, z))
    return np.asarray(q.real), residual, np.asarray(np.linalg.solve(r, z[:, :, None])[:, :, 0].T)


def _energy(
    model: GeometryModel, blocks: Sequence[_Block], dof: Sequence[Sequence[str]], values: Array
) -> float:
    total = 0.0
    for block in blocks:
        rows = _rows(model, block.body, values, dof[block.body])
        total += float(np.sum(np.abs(_fit(block, rows)[1]) ** 2))
    return total


def _information(
    model: GeometryModel, blocks: Sequence[_Block], dof: Sequence[Sequence[str]], values: Array, noise: bool
) -> tuple[Array, Array]:
    """Return twice the projected Gram matrix (k, k) and the score (k,); without the noise of the motion."""
    size = len(values)
    information, score = np.zeros((size, size)), np.zeros(size)
    for block in blocks:
        rows = _rows(model, block.body, values, dof[block.body])
        scale = np.linalg.norm(rows, axis=0)
        q, residual, z = _fit(block, rows)
        places = dof_indices(tuple(dof[block.body]))
        gain = 1.0 + model.gains(block.body, values)
        slopes = np.zeros((size, len(rows), len(places)))
        for change in model.changes(block.body, values):
            factor = gain[change.channels][:, None]
            slopes[change.parameter, change.channels] += factor * change.rows[:, places] / scale
        if q.ndim == 2:
            part, pull = _gram_of_equal_weights(block, slopes, q, rows / scale, residual, z, noise)
        else:
            part, pull = _gram_by_line(block, slopes, q, rows / scale, residual, z, noise)
        information += part
        score += pull
    return 2.0 * information, 2.0 * score


def _gram_of_equal_weights(
    block: _Block, slopes: Array, q: Array, rows: Array, residual: ComplexArray, z: ComplexArray, noise: bool
) -> tuple[Array, Array]:
    """Return Gram matrix and score where all lines share their weights."""
    s = block.s[:, 0]
    white = s[None, :, None] * slopes
    score = np.real(np.einsum("kcm,cf,mf->k", white, residual.conj(), z, optimize=True))
    second = np.real(z @ z.conj().T)
    if noise:
        weighted = s[:, None] * rows
        second = second - block.lines * np.linalg.inv(weighted.T @ weighted)
    values, vectors = np.linalg.eigh(second)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    unexplained = white @ half
    unexplained = unexplained - np.einsum("cm,km...->kc...", q, np.einsum("cm,kc...->km...", q, unexplained))
    flat = unexplained.reshape(len(slopes), -1)
    return flat @ flat.T, score


def _gram_by_line(
    block: _Block, slopes: Array, q: Array, rows: Array, residual: ComplexArray, z: ComplexArray, noise: bool
) -> tuple[Array, Array]:
    """Return Gram matrix and score, line by line in pieces."""
    size = len(slopes)
    information, score = np.zeros((size, size)), np.zeros(size)
    step = max(1, 2_000_000 // (size * slopes.shape[1]))
    for start in range(0, block.s.shape[1], step):
        part = slice(start, start + step)
        s = block.s[:, part].T
        derivative = np.einsum("fc,kcm,mf->fck", s, slopes, z[:, part], optimize=True)
        score += np.real(np.einsum("fck,cf->k", derivative.conj(), residual[:, part], optimize=True))
        information += _gram(derivative, q[part])
        if noise:
            weighted = s[:, :, None] * rows
            gram = np.einsum("fcm,fcn->fmn", weighted, weighted)
            half = np.linalg.cholesky(np.linalg.inv(gram))
            for column in range(half.shape[2]):
                less = np.einsum("fc,kcm,fm->fck", s, slopes, half[:, :, column], optimize=True)
                information -= _gram(less, q[part])
    if noise:
        values, vectors = np.linalg.eigh(information)
        information = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return information, score


def _gram(columns: ComplexArray | Array, q: Array) -> Array:
    """Return the real Gram matrix of columns (line, channel, k) off the columns q (line, channel, m)."""
    projected = q.transpose(0, 2, 1) @ columns
    flat, inside = columns.reshape(-1, columns.shape[2]), projected.reshape(-1, columns.shape[2])
    return np.real(flat.conj().T @ flat) - np.real(inside.conj().T @ inside)


def _solve(matrix: Array, right: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(matrix))
    return np.asarray(scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * right))


def _inverse(matrix: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(matrix))
    inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.asarray(0.5 * (inverse + inverse.T))


def _notices(calibration: Calibration) -> tuple[Notice, ...]:
    notices = []
    unseen = [name for name, seen in zip(calibration.model.names, calibration.seen, strict=True) if not seen]
    groups = _group(unseen)
    seen = f"{int(np.sum(calibration.seen))} of {len(calibration.seen)}"
    text = (
        f"calibration: the data tell {seen} parameters of the geometry"
        + (f"; as uncertain as before: {groups}" if groups else "")
        + ". No residual shows a shift of all points of a body together, nor a turn of positions and beams "
        "together, nor one gain common to all lasers: those rest on fiducials and references alone."
    )
    notices.append(Notice("calibrated", text))
    if calibration.p_value < _UNLIKELY:
        worst = int(np.argmax(np.abs(calibration.values) / calibration.model.prior_sd))
        name = calibration.model.names[worst]
        _, factor, unit = shown(name)
        sizes = (calibration.values[worst], calibration.sd[worst], calibration.model.prior_sd[worst])
        value, sd, prior = (factor * size for size in sizes)
        size = f"{name} by {value:+.3g} ± {sd:.2g}{'' if unit == '°' else ' '}{unit} (stated {prior:.2g})"
        text = (
            "calibration: the data pull the geometry beyond what the stated errors allow "
            f"(chi2 {calibration.chi2:.3g} for {calibration.n_dof}, p {calibration.p_value:.1g}), "
            f"most {size}. Check {named('axes_sd')}, {named('beam_sd')} and sd_mm, and the channels with a "
            "verdict."
        )
        notices.append(Notice("calibration_beyond_priors", text))
    return tuple(notices)


def _group(names: Sequence[str]) -> str:
    """Name parameters by group, a long list of points by their number."""
    places = [name.split(".")[1:-1] for name in names if name.startswith("position.")]
    points = list(dict.fromkeys(" ".join(place) for place in places))
    others = [name for name in names if not name.startswith("position.")]
    if len(points) > 4:
        others.append(f"components of the positions of {len(points)} points")
    elif points:
        others.append("positions of " + ", ".join(points))
    return ", ".join(others)
