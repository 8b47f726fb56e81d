"""How large a fault must be to be found: what a clean verdict excludes; and errors that never show."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from legacy.kinematics.faults.catalogue import KINDS
from legacy.kinematics.faults.nuisance import Marginal, Nuisance, information_of
from legacy.kinematics.faults.packed_readings import Source, initial, real_parts
from legacy.kinematics.faults.score_information import SHIFTS, State
from legacy.kinematics.faults.score_tests import of_one_size, scores_at
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import BodyChannels
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.spatial import dof_indices

# Probability with which a fault of the stated size is found.
POWER = 0.95
# Errors for which effects are stated (they are in proportion), and how parallel beams of one direction are.
TURN_DEG, SHIFT_UM, PARALLEL = 1.0, 50.0, 1e-4
# Points that are paired with each other, which bound the time.
_MOST_POINTS = 60
# Information along one direction over that along another, below which it is rounding; and errors, in
# units of the motion, rad and levers, of which only rounding shows anything.
_UNSEEN, _NEVER = 1e-9, 1e3


@dataclass(frozen=True)
class Detectable:
    """The smallest faults of one body in one run that are found with probability POWER.

    Attributes
    ----------
    gain : ndarray, (channel,)
        Relative error of the amplitude of one channel; NaN where it cannot be found, as below.
    angle_rad : ndarray, (channel,)
        Error of the direction of one beam, in the plane in which it shows least.
    shift_m : ndarray, (channel,)
        Error of the position of the channel's point, along the line on which it shows least.
    axes_rad : float
        Turn of all beams against the positions, about the axis about which it shows least.
    pairs : tuple of (str, str, float, float)
        Two points, their distance, mm, and the probability with which an exchange of their names is found:
        the closest pair, and the one that shows least. Of more than 60 points the first 60.
    """

    gain: Array
    angle_rad: Array
    shift_m: Array
    axes_rad: float
    pairs: tuple[tuple[str, str, float, float], ...]


def detectable(fit: LineFit, body: BodyChannels, freq_hz: Array, alarm: float) -> Detectable:
    """Find the smallest faults from the information that the score tests have on them.

    Parameters
    ----------
    fit : LineFit
        With known noise, and at least one determined line.
    body : BodyChannels
        In the frame of the fit.
    freq_hz : ndarray, (freq,)
    alarm : float
        Probability of a false alarm that one test may have.

    Notes
    -----
    The statistic of k parameters is noncentral chi2 (Kay 1998, Detection Theory, section 6.5) with the
    information beside the motion and beside the errors of positions with a stated sd.
    """
    data = initial(Source.of(fit, body, freq_hz, known=True), body)
    state = State.of(data)
    nuisance = Nuisance.of(data, np.nan_to_num(body.position_sd_mm) * 1e-3)
    near = Marginal(state, nuisance)
    points = data.by_point

    def smallest(kind: str, places: list[list[int]]) -> Array:
        found = np.full(len(body.points), np.nan)
        for same in of_one_size(places):
            information = 2.0 * scores_at(near, same, KINDS[kind].tangents)[1]
            for own, one in zip(same, information, strict=True):
                unit = KINDS[kind].unit(fit.beams.lever_m)
                found[own] = _least(one * unit**2, alarm) * unit
        return found

    single = [[channel] for channel in data.live]
    return Detectable(
        smallest("gain", single),
        smallest("direction", single),
        smallest("position", list(points.values())),
        float(smallest("axes", [data.live])[data.live[0]]),
        _pairs(state, nuisance, dict(list(points.items())[:_MOST_POINTS]), alarm),
    )


def _least(information: Array, alarm: float) -> float:
    """Return the size of a fault along its hardest direction; NaN where it never shows."""
    from scipy.special import chdtri, chndtrinc

    size = len(information)
    values = np.linalg.eigvalsh(information)
    if not values[0] > _UNSEEN * values[-1]:
        return float("nan")
    needed = float(chndtrinc(float(chdtri(size, alarm)), size, 1.0 - POWER))
    least = float(np.sqrt(needed / values[0]))
    return least if least < _NEVER else float("nan")


def _pairs(
    state: State, nuisance: Nuisance, points: dict[str, list[int]], alarm: float
) -> tuple[tuple[str, str, float, float], ...]:
    """Return the closest pair of points, and the one whose exchange shows least.

    With I the information on the shifts of all points and S their stated errors, shifts s are noncentral by
    s^T (I - I S (1 + S I S)^-1 S I) s.
    """
    from scipy.special import chdtri, chndtr

    if len(points) < 2:
        return ()
    information = 2.0 * information_of(state, list(points.values()), SHIFTS)[1]
    first = [own[0] for own in points.values()]
    spread = np.append(nuisance.sd, 0.0)[nuisance.owner[:, first]].T.ravel()
    wide = spread[:, None] * information
    seen = information - wide.T @ np.linalg.solve(np.eye(len(spread)) + wide * spread, wide)
    places, names = state.data.assumed.arms_m[first], list(points)
    pairs = []
    for one, two in combinations(range(len(names)), 2):
        apart = places[two] - places[one]
        shift = np.zeros((len(names), 3))
        shift[one], shift[two] = apart, -apart
        excess = max(float(shift.ravel() @ seen @ shift.ravel()), 0.0)
        power = 1.0 - float(chndtr(float(chdtri(3, alarm)), 3, excess)) if excess < 1e4 else 1.0
        pairs.append((names[one], names[two], 1e3 * float(np.linalg.norm(apart)), power, excess))
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
    q, places = q[np.all(np.isfinite(q), axis=1)], np.array(dof_indices(dof))
    size = np.maximum(np.sqrt(np.mean(np.abs(q) ** 2, axis=0)), 1e-300)[places]
    crossed = np.stack([np.cross(q.reshape(-1, 2, 3), axis) for axis in np.eye(3)])
    turned = -crossed.reshape(3, -1, 6)
    shifted = np.concatenate([crossed[:, :, 1], np.zeros_like(crossed[:, :, 1])], axis=2)

    def worst(change: ComplexArray) -> Array:
        largest = [np.linalg.norm(real_parts(change[:, :, place]), 2) for place in places]
        return np.array(largest) / np.sqrt(max(len(q), 1)) / size

    tilt = np.full(len(places), np.nan)
    if np.linalg.svd(directions, compute_uv=False)[1:].max(initial=0.0) < PARALLEL * np.sqrt(len(directions)):
        large = float(np.sqrt(np.max(np.mean(np.abs(q[:, :3]) ** 2, axis=0))))
        tilt = np.where(places < 3, np.tan(np.radians(TURN_DEG)) * max(large, 1e-300) / size, np.nan)
    return Invisible(np.radians(TURN_DEG) * worst(turned), 1e-6 * SHIFT_UM * worst(shifted), tilt)
