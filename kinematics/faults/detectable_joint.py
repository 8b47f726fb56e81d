"""How large errors of all beams, and exchanges of two points, must be to be found; and what never shows."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.detectable import POWER
from kinematics.fit import symmetric_batches as packed
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array, ComplexArray
from stapeskit.spatial import dof_indices

# Errors for which effects are stated (they are in proportion), and how parallel beams of one direction are.
TURN_DEG, SHIFT_UM, PARALLEL = 1.0, 50.0, 1e-4
# Numbers that are held at once; lines and points that are looked at, which bound the time.
_HELD = 3_000_000
_MOST_LINES, _MOST_POINTS = 400, 60


@dataclass(frozen=True)
class Joint:
    """What concerns several points of one body in one run.

    Attributes
    ----------
    axes_rad : float
        The smallest turn of all beams against the positions, about the axis about which it shows least, that
        is found with probability POWER; NaN where it cannot be found.
    pairs : tuple of (str, str, float, float)
        Two points, their distance, mm, and the probability with which an exchange of their names is found:
        the closest pair, and the one that shows least.
    """

    axes_rad: float
    pairs: tuple[tuple[str, str, float, float], ...]


def joint(fit: LineFit, body: BodyChannels, q: ComplexArray, alarm: float) -> Joint:
    """Find what a clean verdict says about turned axes and exchanged points; see detectable.

    Parameters
    ----------
    fit : LineFit
        With known noise.
    body : BodyChannels
    q : ndarray, (freq, 6), complex
        Fitted motion, zero where not fitted, m and rad.
    alarm : float
        Probability of a false alarm that one test may have.

    Notes
    -----
    A turn p of all beams d changes the readings of u by p . (d x u), a shift s of a point by s . (d x omega),
    an exchange of two points shifts each to the other. With I the information on turn and shifts beside the
    motion and S the stated position errors, an error e is noncentral by e^T (I - I S (1 + S I S)^-1 S I) e.
    More than 60 points are not paired with each other, and their turned axes are judged by 60 of them.
    """
    points = list(dict.fromkeys(body.points))
    used = np.flatnonzero(fit.solution.good)
    if not used.size or len(points) < 2:
        return Joint(float("nan"), ())
    chosen = points[:_MOST_POINTS]
    information = _information(fit, body, q, used, chosen)
    sd = np.array([_sd_m(body, name) for name in chosen])
    spread = np.concatenate([np.zeros(3), np.repeat(sd, 3)])
    wide = spread[:, None] * information
    inner = np.eye(len(spread)) + wide * spread
    seen = information - wide.T @ np.linalg.solve(inner, wide)
    return Joint(_axes(seen[:3, :3], alarm), _pairs(seen[3:, 3:], body, chosen, alarm))


def _sd_m(body: BodyChannels, point: str) -> float:
    return float(np.nan_to_num(body.position_sd_mm[body.points.index(point)]) * 1e-3)


def _information(
    fit: LineFit, body: BodyChannels, q: ComplexArray, used: NDArray[np.intp], points: list[str]
) -> Array:
    """Return the information (3 + 3 points, same) on a turn of all beams and shifts of the points."""
    own = np.array([c for c, name in enumerate(body.points) if name in set(points)])
    size = 3 + 3 * len(points)
    most = int(np.clip(_HELD // (len(own) * size), 8, _MOST_LINES))
    pick = used[np.unique(np.linspace(0, len(used) - 1, most).round().astype(int))]
    weight = 0.5 / fit.at(pick)[1][own] ** 2
    basis = fit.beams.basis[own]
    inverse = packed.unpack(fit.solution.inverse[:, pick], basis.shape[1])
    place = np.array([points.index(body.points[c]) for c in own])
    total = np.zeros((size, size))
    for k, line in enumerate(pick):
        turns = q[line, 3:]
        local = q[line, :3] + np.cross(turns, body.positions_mm[own] * 1e-3)
        columns = np.zeros((len(own), size), dtype=complex)
        columns[:, :3] = np.cross(body.directions[own], local)
        slopes = np.cross(body.directions[own], turns)
        columns[np.arange(len(own))[:, None], 3 + 3 * place[:, None] + np.arange(3)] = slopes
        weighted = columns * weight[:, k, None]
        side = basis.T @ weighted
        total += 2.0 * np.real(columns.conj().T @ weighted - side.conj().T @ inverse[k] @ side)
    return np.asarray(total * (len(used) / len(pick)))


def _axes(information: Array, alarm: float) -> float:
    from scipy.special import chdtri, chndtrinc

    values = np.linalg.eigvalsh(information)
    if not values[0] > 1e-9 * values[-1]:
        return float("nan")
    needed = float(chndtrinc(float(chdtri(3, alarm)), 3, 1.0 - POWER))
    return float(np.sqrt(needed / values[0]))


def _pairs(
    seen: Array, body: BodyChannels, points: list[str], alarm: float
) -> tuple[tuple[str, str, float, float], ...]:
    """Return the closest pair of points, and the one whose exchange shows least."""
    from scipy.special import chdtri, chndtr

    places = np.array([body.positions_mm[body.points.index(name)] for name in points])
    pairs = []
    for one, two in combinations(range(len(points)), 2):
        apart = (places[two] - places[one]) * 1e-3
        shift = np.zeros(len(seen))
        shift[3 * one : 3 * one + 3], shift[3 * two : 3 * two + 3] = apart, -apart
        excess = max(float(shift @ seen @ shift), 0.0)
        power = 1.0 - float(chndtr(float(chdtri(3, alarm)), 3, excess)) if excess < 1e4 else 1.0
        distance = 1e3 * float(np.linalg.norm(apart))
        pairs.append((points[one], points[two], distance, power, excess))
    closest = min(pairs, key=lambda pair: pair[2])
    least = min(pairs, key=lambda pair: pair[4])
    return tuple(pair[:4] for pair in dict.fromkeys((closest, least)))


@dataclass(frozen=True)
class Invisible:
    """Largest relative change (rms) of each fitted motion by an error that leaves no residual.

    Attributes
    ----------
    turn : ndarray, (m,)
        All points and beams turned together by TURN_DEG, about the worst axis.
    shift : ndarray, (m,)
        All points shifted together by SHIFT_UM, along the worst line.
    tilt : ndarray, (m,)
        For beams of one direction only: motion across the beams as large as the largest translation, taken in
        by a tilt of TURN_DEG; NaN with beams of several directions, whose tilt shows.
    """

    turn: Array
    shift: Array
    tilt: Array


def invisible(q: ComplexArray, dof: tuple[str, ...], directions: Array) -> Invisible:
    """Return what errors that never show would do to the motion.

    Parameters
    ----------
    q : ndarray, (freq, 6), complex
        Motion, zero where not fitted.
    dof : tuple of str, (m,)
        Fitted degrees of freedom.
    directions : ndarray, (channel, 3)

    Notes
    -----
    Frames turned by p change a twist (v, omega) by (p x v, p x omega), shifted by s by (omega x s, 0)
    (Featherstone 2008, Rigid Body Dynamics Algorithms, section 2.8).
    """
    good = np.all(np.isfinite(q), axis=1)
    v, omega = q[good, :3], q[good, 3:]
    axes = np.eye(3)
    turned = np.stack([np.hstack([np.cross(e, v), np.cross(e, omega)]) for e in axes], axis=-1)
    still = np.zeros_like(v)
    shifted = np.stack([np.hstack([np.cross(omega, e), still]) for e in axes], axis=-1)
    places = dof_indices(dof)
    size = np.maximum(np.sqrt(np.mean(np.abs(q[good]) ** 2, axis=0)), 1e-300)

    def worst(change: ComplexArray) -> Array:
        largest = []
        for place in places:
            square = np.real(change[:, place].conj().T @ change[:, place]) / max(len(change), 1)
            largest.append(np.sqrt(max(float(np.linalg.eigvalsh(square)[-1]), 0.0)) / size[place])
        return np.array(largest)

    tilt = np.full(len(places), np.nan)
    if np.linalg.svd(directions, compute_uv=False)[1:].max(initial=0.0) < PARALLEL * np.sqrt(len(directions)):
        large = float(np.max(size[:3]))
        beside = [np.tan(np.radians(TURN_DEG)) * large / size[place] for place in places]
        tilt = np.where(np.array(places) < 3, beside, np.nan)
    return Invisible(np.radians(TURN_DEG) * worst(turned), 1e-6 * SHIFT_UM * worst(shifted), tilt)
