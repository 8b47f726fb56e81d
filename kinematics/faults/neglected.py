"""What a fitted subset of the degrees of freedom takes for its own: motion that oblique beams pick up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.beams import WEAK, BeamSet, beam_set, observability
from kinematics.fit.rigid_fit import LineFit, refitted
from kinematics.measurement import BodyChannels
from kinematics.notices import Notice
from kinematics.spatial import DOF_NAMES, dof_indices

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_PREFERENCE = ("y", "alpha", "gamma", "x", "z", "beta")
_LEAK = 0.02
_BIAS = 0.005


def extended_dof(body: BodyChannels, dof: tuple[str, ...]) -> tuple[str, ...]:
    """Return the fitted degrees of freedom with all others that the beams observe beside them."""
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
    they do not observe apart from the fitted one is told by its geometric leak.
    """
    dof = fit.beams.dof
    if len(dof) == 6:
        return []
    weight = fit.channel_weight
    if not np.any(weight > 0.0):
        return []
    leak = leaks(fit, weight / np.max(weight))
    wide = extended_dof(body, dof)
    texts = _hidden(leak, dof, [name for name in DOF_NAMES if name not in wide], fit.beams.lever_m)
    if wide != dof:
        texts += _measured(fit, body, leak, wide)
    if not texts:
        return []
    return [Notice("neglected_motion", f"body {body.body}{where}: {'; '.join(texts)}.")]


def _hidden(leak: Array, dof: tuple[str, ...], unseen: list[str], lever: float) -> list[str]:
    """Describe leaks of motions that cannot be told from the fitted ones, made dimensionless by the lever."""
    length = np.array([1.0, 1.0, 1.0, lever, lever, lever])
    texts = []
    for name in unseen:
        column = DOF_NAMES.index(name)
        entries = leak[:, column] * length[dof_indices(dof)] / length[column]
        row = int(np.argmax(np.abs(entries)))
        if abs(entries[row]) > _LEAK:
            share = f"{100.0 * abs(entries[row]):.2g} %"
            texts.append(
                f"the beams cannot tell {name} from the fitted motion, and {share} of it enters {dof[row]}"
            )
    return texts


def _measured(fit: LineFit, body: BodyChannels, leak: Array, wide: tuple[str, ...]) -> list[str]:
    """Describe significant measured motion outside the subset and its effect on the fitted motion."""
    from scipy.special import chdtrc

    dof = fit.beams.dof
    full = refitted(beam_set(body.body, body.positions_mm, body.directions, wide), fit)
    good = np.isfinite(full.chi2) & np.isfinite(fit.chi2)
    if not np.any(good):
        return []
    fall = float(np.sum(fit.chi2[good] - full.chi2[good]))
    freedom = float(np.sum(fit.n_dof[good] - full.n_dof[good]))
    left = float(np.sum(full.chi2[good])) / max(float(np.sum(full.n_dof[good])), 1.0)
    if chdtrc(max(freedom, 1.0), fall / max(left, 1e-300)) > 1e-3:
        return []
    extra = [name for name in wide if name not in dof]
    others = full.q[good][:, [wide.index(name) for name in extra]]
    bias = others @ leak[:, dof_indices(tuple(extra))].T
    size = np.sqrt(np.mean(np.abs(fit.q[good]) ** 2, axis=0))
    share = np.sqrt(np.mean(np.abs(bias) ** 2, axis=0)) / np.maximum(size, 1e-300)
    row = int(np.argmax(share))
    if share[row] < _BIAS:
        return []
    return [
        f"measured motion in {', '.join(extra)} is left out of the fit and changes {dof[row]} by "
        f"{100.0 * share[row]:.2g} % (rms); fit it with --dof {','.join(wide)}"
    ]
