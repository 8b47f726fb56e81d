"""Motion outside a fitted subset of the degrees of freedom that oblique beams measure as part of it."""

from __future__ import annotations

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.fit.beams import WEAK, BeamSet, beam_set, observability
from legacy.kinematics.fit.rigid_fit import LineFit, refit
from legacy.kinematics.measurement import BodyChannels
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.option_names import named
from legacy.stapeskit.spatial import DOF_NAMES, dof_indices
from legacy.stapeskit.warnings import Notice

_PREFERENCE = ("y", "alpha", "gamma", "x", "z", "beta")
_LEAST_LEAK: float = calibrated("neglected_motion.least_leak")
_LEAST_BIAS: float = calibrated("neglected_motion.least_bias")
# The effect is reported for a neglected motion of a fifth of the piston motion.
_FIFTH = 0.2


def extended_dof(body: BodyChannels, dof: tuple[str, ...]) -> tuple[str, ...]:
    """Return the fitted degrees of freedom and all others that the beams can observe with them."""
    arms = body.positions_mm * 1e-3
    chosen = set(dof)
    for name in _PREFERENCE:
        trial = tuple(n for n in DOF_NAMES if n in chosen | {name})
        enough = len(arms) > len(trial)
        if name not in chosen and enough and observability(arms, body.directions, trial)[-1] > WEAK:
            chosen.add(name)
    return tuple(name for name in DOF_NAMES if name in chosen)


def extended_beams(body: BodyChannels, dof: tuple[str, ...]) -> BeamSet:
    """Return the beam set of extended_dof."""
    return beam_set(body.body, body.positions_mm, body.directions, extended_dof(body, dof))


def leaks(fit: LineFit, channel_weight: Array) -> Array:
    """Return d(fitted DOF)/d(each of the six motions), (m, 6), with mean weights; identity on fitted ones."""
    rows = fit.beams.rows
    root = np.sqrt(channel_weight)[:, None]
    scale = np.linalg.norm(rows, axis=0)
    solved = np.linalg.lstsq(root * rows / scale, root * fit.beams.all_rows, rcond=None)[0]
    return np.asarray(solved / scale[:, None])


def neglected_notice(fit: LineFit, body: BodyChannels, where: str) -> list[Notice]:
    """Warn when motion outside the fitted subset enters it.

    Motion that the beams do observe is measured, and its effect stated when it is significant; motion that
    they cannot separate from the fitted one is reported by its geometric leak.
    """
    dof = fit.beams.dof
    if len(dof) == 6:
        return []
    weight = fit.channel_weight
    if not np.any(weight > 0.0):
        return []
    leak = leaks(fit, weight / np.max(weight))
    wide = extended_dof(body, dof)
    texts = _describe_hidden(leak, dof, [name for name in DOF_NAMES if name not in wide], fit.beams.lever_m)
    if wide != dof:
        texts += _describe_measured(fit, body, leak, wide)
    if not texts:
        return []
    return [Notice("neglected_motion", f"body {body.body}{where}: {'; '.join(texts)}.")]


def _describe_hidden(leak: Array, dof: tuple[str, ...], unseen: list[str], lever: float) -> list[str]:
    """Describe leaks of motions that cannot be separated from the fitted ones, dimensionless by the lever."""
    texts = []
    for name in unseen:
        rows = _affected_motions(leak, dof, name, lever)
        if not rows:
            continue
        leaks = _describe_entering(leak, dof, name, rows)
        text = f"the beams cannot tell {name} from the fitted motion, and {leaks}"
        for row in [row for row in rows if name in DOF_NAMES[:3] and dof[row] in DOF_NAMES[:3]][:1]:
            size = 100.0 * _FIFTH * abs(leak[row, DOF_NAMES.index(name)])
            text += f" (if {name} is a fifth of {dof[row]}, that is {_digits(size)} % of {dof[row]})"
        texts.append(text)
    return texts


def _affected_motions(leak: Array, dof: tuple[str, ...], name: str, lever: float) -> list[int]:
    """Return the fitted motions that another enters by more than 2 %, the most first."""
    length = np.array([1.0, 1.0, 1.0, lever, lever, lever])
    column = DOF_NAMES.index(name)
    entries = np.abs(leak[:, column]) * length[dof_indices(dof)] / length[column]
    return [int(k) for k in np.argsort(-entries, kind="stable") if entries[k] > _LEAST_LEAK]


def _digits(value: float) -> str:
    """Write a number to two digits, without an exponent from 100 on."""
    return f"{float(f'{value:.2g}'):g}"


def _describe_entering(leak: Array, dof: tuple[str, ...], name: str, rows: list[int]) -> str:
    """Describe how much of a motion enters the fitted ones, per unit of it."""
    column, parts = DOF_NAMES.index(name), []
    for row in rows:
        value, turns = abs(leak[row, column]), dof[row] in DOF_NAMES[3:]
        if turns == (column > 2):
            parts.append(f"{_digits(100.0 * value)} % of it enters {dof[row]}")
        elif turns:
            parts.append(f"{_digits(1e-3 * value)} urad enter {dof[row]} per nm of it")
        else:
            parts.append(f"{_digits(1e3 * value)} nm enter {dof[row]} per urad of it")
    return " and ".join(parts) or "little of it enters the others"


def _describe_measured(fit: LineFit, body: BodyChannels, leak: Array, wide: tuple[str, ...]) -> list[str]:
    """Describe significant measured motion outside the subset, its size and its effect on the fitted motion.

    Notes
    -----
    The fall of chi2 between the two fits tests whether the motion is there. Its mean square exceeds that of
    the motion by the variance of the estimate, which is subtracted.
    """
    from scipy.special import chdtrc

    dof = fit.beams.dof
    full = refit(beam_set(body.body, body.positions_mm, body.directions, wide), fit)
    good = np.isfinite(full.chi2) & np.isfinite(fit.chi2)
    if not np.any(good):
        return []
    fall = float(np.sum(fit.chi2[good] - full.chi2[good]))
    freedom = float(np.sum(fit.n_dof[good] - full.n_dof[good]))
    left = float(np.sum(full.chi2[good])) / max(float(np.sum(full.n_dof[good])), 1.0)
    chance = float(chdtrc(max(freedom, 1.0), fall / max(left, 1e-300)))
    if chance > 1e-3:
        return []
    extra = [name for name in wide if name not in dof]
    places = [wide.index(name) for name in extra]
    others = full.q[good][:, places]
    bias = others @ leak[:, dof_indices(tuple(extra))].T
    size = np.sqrt(np.mean(np.abs(fit.q[good]) ** 2, axis=0))
    share = np.sqrt(np.mean(np.abs(bias) ** 2, axis=0)) / np.maximum(size, 1e-300)
    if np.max(share) < _LEAST_BIAS:
        return []
    worst = [int(k) for k in np.argsort(-share, kind="stable") if share[k] >= _LEAST_BIAS]
    changes = ", ".join(f"{dof[k]} by {_digits(100.0 * share[k])} %" for k in worst)
    variance = np.real(full.covariance[good][:, places, places]) * left
    parts = []
    for k, name in enumerate(extra):
        unit, scale = ("nm", 1e9) if name in DOF_NAMES[:3] else ("urad", 1e6)
        rms, sd = _size_of(others[:, k], variance[:, k])
        entered = _affected_motions(leak, dof, name, fit.beams.lever_m)
        rows = [row for row in entered if row in worst] or entered[:1]
        if not rows and len(extra) > 1:
            continue
        entering = _describe_entering(leak, dof, name, rows)
        parts.append(f"{name} {scale * rms:.3g} +- {scale * sd:.2g} {unit} rms ({entering})")
    odds = "< 1e-300" if chance < 1e-300 else f"{chance:.1g}"
    return [
        f"measured motion in {', '.join(extra)} is left out of the fit and changes {changes} (rms): "
        f"{', '.join(parts)}; without such motion the probability of these "
        f"data is {odds}; fit it with {named('dof')} {','.join(wide)}"
    ]


def _size_of(values: ComplexArray, variance: Array) -> tuple[float, float]:
    """Return the root mean square of a motion (freq,) freed of its noise, and its standard deviation."""
    noise = float(np.mean(variance))
    power = max(float(np.mean(np.abs(values) ** 2)) - noise, 0.0)
    spread = np.sqrt(np.mean(2.0 * np.maximum(np.abs(values) ** 2 - variance, 0.0) * variance + variance**2))
    rms = np.sqrt(power)
    return float(rms), float(spread / np.sqrt(len(values)) / max(2.0 * rms, np.sqrt(noise), 1e-300))
