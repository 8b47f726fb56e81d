"""Motion outside the chosen degrees of freedom that oblique beams measure as part of them."""

from __future__ import annotations

import numpy as np

from kinematics.fit.beams import WEAK, beam_set, observable_dof
from kinematics.fit.rigid_fit import LineFit, refit
from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array
from stapeskit.spatial import DOF_NAMES, dof_indices
from stapeskit.warnings import Notice

LEAST_LEAK = 0.02
"""Share of a hidden motion that enters a fitted one from which on it is reported: a hidden motion is rarely
larger than the fitted ones, so that below it the effect is within the errors of lasers (1 %)."""
LEAST_BIAS = 0.005
"""Relative bias by measured motion from which on it is reported: half the error of a laser."""

_CHANCE = 1e-3  # probability of the data without such motion below which it is there


def neglected_notice(fit: LineFit, body: BodyChannels, where: str = "") -> list[Notice]:
    """Warn when motion outside the fitted subset enters it.

    Motion that the beams do observe is measured, and its effect reported when it is significant; motion that
    they cannot separate from the fitted one is reported by its geometric leak.
    """
    dof, weight = fit.beams.dof, fit.solution.weight
    if len(dof) == 6 or not np.any(weight > 0.0):
        return []
    leak = leak_matrix(fit, weight / np.max(weight))
    wide = observable_dof(body.arms_m, body.directions, dof, WEAK, spare=1)
    hidden = [name for name in DOF_NAMES if name not in wide]
    texts = _hidden_texts(leak, dof, hidden, fit.beams.lever_m)
    texts += _measured_texts(fit, body, leak, wide) if wide != dof else []
    text = f"body {body.body}{where}: {'; '.join(texts)}."
    return [Notice("neglected_motion", text)] if texts else []


def leak_matrix(fit: LineFit, channel_weight: Array) -> Array:
    """Return d(fitted motion) / d(each of the six motions), (m, 6); identity on fitted ones."""
    rows = fit.beams.rows
    root = np.sqrt(channel_weight)[:, None]
    scale = np.linalg.norm(rows, axis=0)
    solved = np.linalg.lstsq(root * rows / scale, root * fit.beams.all_rows, rcond=None)[0]
    return np.asarray(solved / scale[:, None])


def _hidden_texts(leak: Array, dof: tuple[str, ...], hidden: list[str], lever: float) -> list[str]:
    """Describe motions that the beams cannot separate from the fitted ones; turns count as lengths."""
    length = np.array([1.0, 1.0, 1.0, lever, lever, lever])
    texts = []
    for name in hidden:
        own = leak[:, DOF_NAMES.index(name)]
        share = np.abs(own) * length[dof_indices(dof)] / length[DOF_NAMES.index(name)]
        large = [k for k in np.argsort(-share) if share[k] > LEAST_LEAK]
        parts = " and ".join(f"{100.0 * share[k]:.2g} % of it enters {dof[k]}" for k in large)
        if parts:
            texts.append(f"the beams cannot tell {name} from the fitted motion: {parts}")
    return texts


def _measured_texts(fit: LineFit, body: BodyChannels, leak: Array, wide: tuple[str, ...]) -> list[str]:
    """Describe significant measured motion outside the subset and its effect on the fitted motion.

    Notes
    -----
    The fall of chi2 between the two fits tests whether the motion is there.
    """
    from scipy.special import chdtrc

    dof = fit.beams.dof
    full = refit(beam_set(body.body, body.arms_m, body.directions, wide), fit)
    good = np.isfinite(full.chi2) & np.isfinite(fit.chi2)
    if not np.any(good):
        return []
    (before, free_before), (after, free_after) = (
        (float(np.sum(one.chi2[good])), float(np.sum(one.n_dof[good]))) for one in (fit, full)
    )
    left = max(after / max(free_after, 1.0), 1e-300)
    chance = float(chdtrc(max(free_before - free_after, 1.0), (before - after) / left))
    extra = tuple(name for name in wide if name not in dof)
    others = full.q[good][:, [wide.index(name) for name in extra]]
    bias = others @ leak[:, dof_indices(extra)].T
    size = np.sqrt(np.mean(np.abs(fit.q[good]) ** 2, axis=0))
    share = np.sqrt(np.mean(np.abs(bias) ** 2, axis=0)) / np.maximum(size, 1e-300)
    if chance > _CHANCE or np.max(share) < LEAST_BIAS:
        return []
    worst = [int(k) for k in np.argsort(-share, kind="stable") if share[k] >= LEAST_BIAS]
    changes = ", ".join(f"{dof[k]} by {100.0 * share[k]:.2g} %" for k in worst)
    odds = "below 1e-300" if chance < 1e-300 else f"{chance:.1g}"
    return [
        f"measured motion in {', '.join(extra)} is left out of the fit and changes {changes} (rms)"
        f"; without it the probability of these data is {odds}; fit it with --dof {','.join(wide)}"
    ]
