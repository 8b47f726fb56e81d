"""Check that positions and beams have the same axes: rigid motion shows an axis mirrored in one alone."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import MIRRORS, Measurement
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.frames import RigidTransform
from legacy.stapeskit.option_names import named
from legacy.stapeskit.spatial import dof_indices, point_rows
from legacy.stapeskit.warnings import Notice

_LEAST_MISFIT: float = calibrated("handedness.least_misfit")
_CURED_SHARE: float = calibrated("handedness.cured_share")
_CURED_SHARE_UNKNOWN_NOISE: float = calibrated("handedness.cured_share_unknown_noise")
# Lines that are looked at: a mirror image shows at every line.
_MOST_LINES = 60


def check_axes(
    placed: Measurement,
    footplate_from_source: RigidTransform,
    fits: Mapping[tuple[int, int], LineFit],
    kept: Mapping[tuple[int, int], float] | None = None,
) -> list[Notice]:
    """Refuse positions that agree with the beams only when an axis is reversed or two are exchanged.

    Parameters
    ----------
    placed : Measurement
        In the footplate frame.
    footplate_from_source : RigidTransform
        Whose source axes are those of the files.
    fits : mapping of (run, body) to LineFit
    kept : mapping of (run, body) to float, optional
        Share of the misfit of each fit that a single fault of a channel, point or laser leaves; 1 where
        none explains it.

    Returns
    -------
    list of Notice
        ``mirrored_axes`` when a reversed axis explains the readings no better than a single fault does.

    Raises
    ------
    KinematicsError
        With one axis of all positions reversed the misfit falls below a tenth, from more than 4 times the
        noise to the size of the noise; where the noise is not stated, it falls below a fiftieth. The part of
        the misfit that a single fault explains without a reversed axis does not count.

    Notes
    -----
    When positions and beams are both mirrored, v = v0 + omega x r keeps its form with -omega, and no residual
    shows it: there only fiducials off a plane, or points on the surfaces of the scan, tell.
    """
    whole = float(sum(np.nansum(fit.chi2) for fit in fits.values()))
    loud = whole > _LEAST_MISFIT * sum(int(np.sum(fit.n_dof)) for fit in fits.values())
    stated = all(body.sd is not None and not body.relative for body in placed.bodies)
    if stated and not loud:
        return []
    misfits, freedom = _misfits(placed, fits, np.eye(3))
    if freedom < 20:
        return []
    turn = footplate_from_source.rotation
    mirrored = {
        name: _misfits(placed, fits, turn @ change @ turn.T)[0] for name, change in _changes().items()
    }
    best = min(mirrored, key=lambda axis: sum(mirrored[axis].values()))
    after = sum(mirrored[best].values())
    rival = sum(
        mirrored[best][key] + (misfits[key] - mirrored[best][key]) * (kept or {}).get(key, 1.0)
        for key in misfits
    )
    share = _CURED_SHARE if loud else _CURED_SHARE_UNKNOWN_NOISE
    # the excess of chi2 over its mean under noise alone, and at least its standard deviation
    noise, scatter = (float(freedom), float(np.sqrt(2.0 * freedom))) if stated else (0.0, 0.0)
    excess, before_excess, rival_excess = (
        max(size - noise, scatter) for size in (after, sum(misfits.values()), rival)
    )
    if excess > share * before_excess or after > _LEAST_MISFIT * freedom:
        return []
    if excess > share * rival_excess:
        cure = (
            f"give {named('mirror_points')} {best} if their coordinates are left-handed"
            if best in MIRRORS
            else "exchange the two columns if they are"
        )
        text = (
            f"positions whose {_words(best)} would explain the readings as well as the fault that was found; "
            f"{cure}."
        )
        return [Notice("mirrored_axes", text)]
    before, after = (np.sqrt(value / freedom) for value in (sum(misfits.values()), after))
    raise KinematicsError.of(
        "the positions of the points",
        "in the same axes as the beam directions",
        f"positions that agree with the beams only when their {_words(best)} (residuals "
        f"{before:.2g} times the noise as given, {after:.2g} so)",
        next_step=f"One of the two is left-handed: give {{mirror_points}} {best} when it is the "
        f"positions, and with {{mirror}} {best} too when it is the directions"
        if best in MIRRORS
        else "Exchange the two columns of the positions, or of the directions",
    )


def _changes() -> dict[str, Array]:
    """Return the changes of positions that are tried: an axis reversed, or two axes exchanged."""
    changes = {axis: np.diag(signs) for axis, signs in MIRRORS.items()}
    for axis_a, two in combinations(range(3), 2):
        order = [0, 1, 2]
        order[axis_a], order[two] = two, axis_a
        changes[f"{'xyz'[axis_a]} and {'xyz'[two]}"] = np.eye(3)[order]
    return changes


def _words(change: str) -> str:
    return f"{change} is turned round" if change in MIRRORS else f"{change} are exchanged"


def _misfits(
    placed: Measurement, fits: Mapping[tuple[int, int], LineFit], change: Array
) -> tuple[dict[tuple[int, int], float], int]:
    """Return the chi2 of each fit with changed positions, and the degrees of freedom of all fits."""
    totals: dict[tuple[int, int], float] = {}
    freedom = 0
    for (run, number), fit in fits.items():
        body = placed.bodies[number]
        centre = body.positions_mm.mean(axis=0)
        arms = (body.positions_mm - centre) @ change.T * 1e-3
        lines = slice(None, None, max(1, len(placed.freq_hz) // _MOST_LINES))
        _, sd, _ = fit.at(lines)
        used = np.isfinite(sd)
        if len(fit.beams.dof) < 6 or not np.any(used):
            continue
        rows = point_rows(arms, body.directions)[:, dof_indices(fit.beams.dof)]
        rows = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        weight = np.where(used, 1.0 / np.where(used, sd, 1.0), 0.0).T
        value = np.where(used, np.nan_to_num(fit.value[:, lines]), 0.0).T
        white = weight[:, :, None] * rows
        q, _ = np.linalg.qr(white)
        inside = np.einsum("fcm,fc->fm", q, weight * value)
        totals[run, number] = float(np.sum(np.abs(weight * value) ** 2) - np.sum(np.abs(inside) ** 2))
        freedom += 2 * (int(np.sum(used)) - rows.shape[1] * len(weight))
    return totals, freedom
