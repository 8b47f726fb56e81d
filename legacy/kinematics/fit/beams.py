"""What a set of beams can observe of a rigid motion, and the well-conditioned basis of its fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault
from legacy.stapeskit.option_names import named
from legacy.stapeskit.spatial import DOF_NAMES, dof_indices, point_rows

# Strength of a motion in the beams, relative to the strongest: below it is not estimated, below 1 %
# reported.
UNOBSERVABLE = 1e-5
WEAK = 1e-2
_AXES = ("long axis of the footplate", "piston axis", "short axis of the footplate")
_PREFERENCE = ("y", "alpha", "gamma", "x", "z", "beta")


@dataclass(frozen=True)
class BeamSet:
    """The observation matrix of one body's channels, factorised once.

    Attributes
    ----------
    dof : tuple of str, (m,)
    rows : ndarray, (channel, m)
        Displacement along each beam per unit of each degree of freedom (m per m, m per rad).
    all_rows : ndarray, (channel, 6)
        The same for all six.
    basis : ndarray, (channel, m)
        Orthonormal columns that span those of ``rows``.
    to_dof : ndarray, (m, m)
        q = to_dof @ z for coefficients z in the basis.
    lever_m : float
        Root mean square distance of the points from their centroid: the length that makes rotations and
        translations comparable.
    strength : ndarray, (m,)
        Singular values of the dimensionless matrix relative to the largest.
    """

    dof: tuple[str, ...]
    rows: Array
    all_rows: Array
    basis: Array
    to_dof: Array
    lever_m: float
    strength: Array
    weak: str = ""

    @cached_property
    def to_six(self) -> Array:
        """``to_dof`` (6, m) with rows of zeros for degrees of freedom that are not fitted."""
        six = np.zeros((6, len(self.dof)))
        six[dof_indices(self.dof)] = self.to_dof
        return six

    @property
    def condition(self) -> float:
        """Condition number of the dimensionless observation matrix."""
        return float(1.0 / self.strength[-1])


def beam_set(body: str, positions_mm: Array, directions: Array, dof: Sequence[str]) -> BeamSet:
    """Factorise the observation matrix of a body's beams about the origin.

    Parameters
    ----------
    body : str
        For messages.
    positions_mm : ndarray, (channel, 3)
        Relative to the reference point.
    directions : ndarray, (channel, 3)
        Unit vectors.
    dof : sequence of str
        The degrees of freedom to fit.

    Raises
    ------
    KinematicsError
        The beams cannot observe the degrees of freedom; the motions they do not see are named.
    """
    names = tuple(name for name in DOF_NAMES if name in dof)
    arms = np.asarray(positions_mm, dtype=float) * 1e-3
    all_rows = point_rows(arms, directions)
    places = dof_indices(names)
    rows = all_rows[:, places]
    lever = _lever(arms)
    strength = observability(arms, directions, names)
    if len(rows) < len(names) or strength[-1] < UNOBSERVABLE:
        _refuse(body, arms, directions, names)
    scale = np.linalg.norm(rows, axis=0)
    u, s, vt = np.linalg.svd(rows / scale, full_matrices=False)
    weak = ""
    if strength[-1] < WEAK:
        weak = "; ".join(
            _describe(vector, names) for vector in _find_unobserved(arms, directions, names, WEAK)
        )
    return BeamSet(names, rows, all_rows, u, (vt.T / s) / scale[:, None], lever, strength, weak)


def _lever(arms: Array) -> float:
    spread = float(np.sqrt(np.mean(np.sum((arms - arms.mean(axis=0)) ** 2, axis=1)))) if len(arms) else 0.0
    far = float(np.max(np.linalg.norm(arms, axis=1))) if len(arms) else 0.0
    return spread if spread > 1e-9 * max(far, 1e-9) else (far or 1.0)


def _scale(arms: Array, directions: Array, dof: Sequence[str]) -> tuple[Array, Array, Array]:
    """Return the dimensionless matrix (channel, m), its column scales, and the point it refers to.

    All six degrees of freedom are referred to the centroid of the points, where distant reference points
    cost no digits; a subset is defined about the reference point itself.
    """
    whole = len(dof) == 6
    centre = arms.mean(axis=0) if whole and len(arms) else np.zeros(3)
    lever = _lever(arms)
    if not whole and len(arms):
        lever = float(np.sqrt(np.mean(np.sum(arms**2, axis=1)))) or 1.0
    scale = np.array([1.0, 1.0, 1.0, lever, lever, lever])[dof_indices(tuple(dof))]
    return point_rows(arms - centre, directions)[:, dof_indices(tuple(dof))] / scale, scale, centre


def observability(arms: Array, directions: Array, dof: Sequence[str]) -> Array:
    """Return the relative singular values (m,) of the dimensionless observation matrix, largest first."""
    matrix, _, _ = _scale(arms, directions, dof)
    values = np.zeros(len(dof))
    if len(matrix):
        singular = np.linalg.svd(matrix, compute_uv=False)
        values[: len(singular)] = singular
    top = float(values[0]) if len(values) else 0.0
    return values / top if top > 0.0 else values


def observable_subset(arms: Array, directions: Array) -> tuple[str, ...]:
    """Return degrees of freedom that the beams can observe together, the paper's three first."""
    chosen: list[str] = []
    for name in _PREFERENCE:
        trial = [dof for dof in DOF_NAMES if dof in (*chosen, name)]
        if len(arms) >= len(trial) and observability(arms, directions, trial)[-1] > WEAK * 0.1:
            chosen.append(name)
    return tuple(name for name in DOF_NAMES if name in chosen)


def _find_unobserved(arms: Array, directions: Array, dof: Sequence[str], limit: float) -> list[Array]:
    """Return the motions (6,) about the reference point, SI, that move no beam (or hardly any)."""
    matrix, scale, centre = _scale(arms, directions, dof)
    # The triangle has the same right singular vectors, without a square matrix of the channels.
    _, s, vt = np.linalg.svd(np.linalg.qr(matrix, mode="r"), full_matrices=True)
    values = np.zeros(vt.shape[0])
    values[: len(s)] = s
    top = values[0] if values[0] > 0.0 else 1.0
    null = vt[values / top < limit]
    motions = []
    for vector in row_echelon(null):
        motion = np.zeros(6)
        motion[dof_indices(tuple(dof))] = vector / scale
        motion[:3] -= np.cross(motion[3:], centre)
        motions.append(motion)
    return motions


def row_echelon(null: Array) -> Array:
    """Reduce a basis to row echelon form with pivoting, so that each vector has few entries."""
    rows = null.copy()
    done: list[int] = []
    for row in range(len(rows)):
        column = int(np.argmax(np.where(np.isin(np.arange(rows.shape[1]), done), -1.0, np.abs(rows[row]))))
        rows[row] /= rows[row, column]
        for other in range(len(rows)):
            if other != row:
                rows[other] -= rows[other, column] * rows[row]
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
        name = _axis_name(v)
        return f"translation along {name}"
    point = np.cross(omega, v) / turn**2 * 1e3
    slide = float(v @ omega) / turn**2 * 1e3
    if len(dof) < 6 and np.count_nonzero(motion) == 1:
        return f"{DOF_NAMES[3 + int(np.argmax(np.abs(omega)))]}, rotation about {_axis_name(omega)}"
    through = "" if np.linalg.norm(point) < 1e-3 else f" through ({', '.join(f'{p:.3g}' for p in point)}) mm"
    also = "" if abs(slide) < 1e-3 else f" with {slide:.3g} mm per rad along it"
    return f"rotation about {_axis_name(omega)}{through}{also}"


def unseen_motions(positions_mm: Array, directions: Array) -> list[str]:
    """Name the rigid motions (of all six) that the beams of a body do not see."""
    arms = np.asarray(positions_mm, dtype=float) * 1e-3
    return [
        _describe(motion, DOF_NAMES) for motion in _find_unobserved(arms, directions, DOF_NAMES, UNOBSERVABLE)
    ]


def _refuse(body: str, arms: Array, directions: Array, dof: tuple[str, ...]) -> None:
    blind = "; ".join(
        _describe(vector, dof) for vector in _find_unobserved(arms, directions, dof, UNOBSERVABLE)
    )
    subset = observable_subset(arms, directions)
    step = (
        f"Choose {named('dof')} {','.join(subset)} or measure with more beams"
        if subset
        else "Measure with more beams"
    )
    raise KinematicsError(
        Fault(
            f"the degrees of freedom {', '.join(dof)} of body {body}",
            f"observable from its {len(arms)} beams",
            f"unobservable: {blind}",
            next_step=step,
        )
    )
