"""What a set of beams can observe of a rigid motion, and the well-conditioned basis of its fit.

Shapes: c channels, m degrees of freedom in the fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.spatial import DOF_NAMES, dof_indices, point_rows

UNOBSERVABLE = 1e-5
"""Strength of a motion in the beams, relative to the strongest, below which it is not estimated: rounding of
positions in mm with five digits."""
WEAK = 1e-2
"""Strength below which a motion is reported as weak: its sd is 100 times that of the best."""
PREFERENCE = ("y", "alpha", "gamma", "x", "z", "beta")
"""Order in which degrees of freedom are chosen where not all can be observed: those of the paper first."""

_AXES = ("long axis of the footplate", "piston axis", "short axis of the footplate")


@dataclass(frozen=True)
class BeamSet:
    """The observation matrix of one body's channels, factorised once.

    Attributes
    ----------
    dof : tuple of str, (m,)
    rows : ndarray, (c, m)
        Displacement along each beam per unit of each degree of freedom (m per m, m per rad).
    all_rows : ndarray, (c, 6)
        The same for all six.
    basis : ndarray, (c, m)
        Orthonormal columns that span those of ``rows``.
    to_dof : ndarray, (m, m)
        q = to_dof @ z for coefficients z in the basis.
    lever_m : float
        Root mean square distance of the points from their centroid: the length that makes rotations and
        translations comparable.
    weak : str
        The motions that the beams hardly see, in words.
    """

    dof: tuple[str, ...]
    rows: Array
    all_rows: Array
    basis: Array
    to_dof: Array
    lever_m: float
    weak: str = ""


def beam_set(body: str, arms_m: Array, directions: Array, dof: Sequence[str]) -> BeamSet:
    """Factorise the observation matrix of a body's beams about the origin.

    Parameters
    ----------
    arms_m : ndarray, (c, 3)
        Positions relative to the reference point, m.
    directions : ndarray, (c, 3)
        Unit vectors.

    Raises
    ------
    StapeskitError
        The beams cannot observe the degrees of freedom; the motions they do not see are listed.
    """
    names = tuple(name for name in DOF_NAMES if name in dof)
    all_rows = point_rows(arms_m, directions)
    rows = all_rows[:, dof_indices(names)]
    strength = observability(arms_m, directions, names)
    if len(rows) < len(names) or strength[-1] < UNOBSERVABLE:
        raise _refusal(body, arms_m, directions, names)
    scale = np.linalg.norm(rows, axis=0)
    u, s, vt = np.linalg.svd(rows / scale, full_matrices=False)
    motions = _unseen(arms_m, directions, names, WEAK) if strength[-1] < WEAK else []
    weak = "; ".join(_describe(motion, names) for motion in motions)
    return BeamSet(names, rows, all_rows, u, (vt.T / s) / scale[:, None], lever_m(arms_m), weak)


def lever_m(arms_m: Array) -> float:
    """Return the length that makes rotations and translations of these points comparable, m."""
    if len(arms_m) == 0:
        return 1.0
    spread = float(np.sqrt(np.mean(np.sum((arms_m - arms_m.mean(axis=0)) ** 2, axis=1))))
    far = float(np.max(np.linalg.norm(arms_m, axis=1)))
    return spread if spread > 1e-9 * max(far, 1e-9) else (far or 1.0)


def _dimensionless(arms_m: Array, directions: Array, dof: Sequence[str]) -> tuple[Array, Array, Array]:
    """Return the dimensionless matrix (c, m), its column scales, and the point it refers to.

    All six degrees of freedom are referred to the centroid of the points, where distant reference points
    cost no digits; a subset is defined about the reference point itself.
    """
    whole = len(dof) == 6 and len(arms_m) > 0
    centre = arms_m.mean(axis=0) if whole else np.zeros(3)
    lever = lever_m(arms_m)
    if not whole and len(arms_m):
        lever = float(np.sqrt(np.mean(np.sum(arms_m**2, axis=1)))) or 1.0
    places = dof_indices(tuple(dof))
    scale = np.array([1.0, 1.0, 1.0, lever, lever, lever])[places]
    return point_rows(arms_m - centre, directions)[:, places] / scale, scale, centre


def observability(arms_m: Array, directions: Array, dof: Sequence[str]) -> Array:
    """Return the relative singular values (m,) of the dimensionless observation matrix, largest first."""
    matrix, _, _ = _dimensionless(arms_m, directions, dof)
    values = np.zeros(len(dof))
    if len(matrix):
        singular = np.linalg.svd(matrix, compute_uv=False)
        values[: len(singular)] = singular
    top = float(values[0]) if len(values) else 0.0
    return values / top if top > 0.0 else values


def observable_dof(
    arms_m: Array, directions: Array, fixed: Sequence[str] = (), limit: float = 0.1 * WEAK, spare: int = 0
) -> tuple[str, ...]:
    """Return degrees of freedom that the beams can observe together, in the order of preference.

    Those in ``fixed`` are among them in any case; ``limit`` is the least relative strength, ``spare`` the
    number of channels beyond that of the degrees of freedom.
    """
    chosen = set(fixed)
    for name in PREFERENCE:
        trial = [dof for dof in DOF_NAMES if dof in chosen | {name}]
        enough = len(arms_m) >= len(trial) + spare
        if enough and name not in chosen and observability(arms_m, directions, trial)[-1] > limit:
            chosen.add(name)
    return tuple(name for name in DOF_NAMES if name in chosen)


def unseen_motions(arms_m: Array, directions: Array) -> list[str]:
    """Name the rigid motions (of all six) that the beams of a body do not see."""
    motions = _unseen(np.asarray(arms_m, dtype=float), directions, DOF_NAMES, UNOBSERVABLE)
    return [_describe(motion, DOF_NAMES) for motion in motions]


def _unseen(arms_m: Array, directions: Array, dof: Sequence[str], limit: float) -> list[Array]:
    """Return the motions (6,) about the reference point, SI, that move no beam (or hardly any)."""
    matrix, scale, centre = _dimensionless(arms_m, directions, dof)
    # The triangle has the same right singular vectors, without a square matrix of the channels.
    _, s, vt = np.linalg.svd(np.linalg.qr(matrix, mode="r"), full_matrices=True)
    values = np.zeros(vt.shape[0])
    values[: len(s)] = s
    top = values[0] if values[0] > 0.0 else 1.0
    motions = []
    for vector in row_echelon(vt[values / top < limit]):
        motion = np.zeros(6)
        motion[dof_indices(tuple(dof))] = vector / scale
        motion[:3] -= np.cross(motion[3:], centre)
        motions.append(motion)
    return motions


def row_echelon(null: Array) -> Array:
    """Reduce a basis (k, n) to row echelon form with pivoting, so that each vector has few entries."""
    rows = null.copy()
    done: list[int] = []
    for row in range(len(rows)):
        free = ~np.isin(np.arange(rows.shape[1]), done)
        column = int(np.argmax(np.where(free, np.abs(rows[row]), -1.0)))
        rows[row] /= rows[row, column]
        others = np.arange(len(rows)) != row
        rows[others] -= np.outer(rows[others, column], rows[row])
        done.append(column)
    rows[np.abs(rows) < 1e-6] = 0.0
    return rows


def _axis_name(vector: Array) -> str:
    unit = vector / np.linalg.norm(vector)
    place = int(np.argmax(np.abs(unit)))
    if abs(unit[place]) > 0.9998:
        return f"the {'xyz'[place]} axis ({_AXES[place]})"
    unit = unit * np.sign(unit[place])
    return f"({', '.join(f'{value:.3f}' for value in unit)})"


def _describe(motion: Array, dof: Sequence[str]) -> str:
    """Describe what a small motion (6,) about the reference point is."""
    v, omega = motion[:3], motion[3:]
    turn = float(np.linalg.norm(omega))
    if turn == 0.0:
        return f"translation along {_axis_name(v)}"
    point = np.cross(omega, v) / turn**2 * 1e3
    slide = float(v @ omega) / turn**2 * 1e3
    if len(dof) < 6 and np.count_nonzero(motion) == 1:
        return f"{DOF_NAMES[3 + int(np.argmax(np.abs(omega)))]}, rotation about {_axis_name(omega)}"
    through = "" if np.linalg.norm(point) < 1e-3 else f" through ({', '.join(f'{p:.3g}' for p in point)}) mm"
    also = "" if abs(slide) < 1e-3 else f" with {slide:.3g} mm per rad along it"
    return f"rotation about {_axis_name(omega)}{through}{also}"


def _refusal(body: str, arms_m: Array, directions: Array, dof: tuple[str, ...]) -> StapeskitError:
    """Return the error that names what the beams do not see, and what they do."""
    blind = "; ".join(_describe(motion, dof) for motion in _unseen(arms_m, directions, dof, UNOBSERVABLE))
    subset = observable_dof(arms_m, directions)
    step = "Measure with more beams"
    if subset:
        step = f"Choose --dof {','.join(subset)} or measure with more beams"
    return StapeskitError.of(
        f"the degrees of freedom {', '.join(dof)} of body {body}",
        f"observable from its {len(arms_m)} beams",
        f"unobservable: {blind}",
        next_step=step,
    )
