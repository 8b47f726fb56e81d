"""How large a fault must be to be found: what a clean verdict on a channel excludes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kinematics.fit import symmetric_batches as packed
from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels
from stapeskit.arrays import Array, ComplexArray

# Probability with which a fault of the stated size is found.
POWER = 0.95
# Lines that the information is summed over; it is scaled to all.
_MOST_LINES = 400


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
    """

    gain: Array
    angle_rad: Array
    shift_m: Array


def detectable(fit: LineFit, body: BodyChannels, q: ComplexArray, alarm: float) -> Detectable:
    """Find the smallest faults from the motion, the noise and the leverage of every channel.

    Parameters
    ----------
    fit : LineFit
        With known noise.
    body : BodyChannels
        Positions and directions in the frame of q.
    q : ndarray, (freq, 6), complex
        Fitted motion, zero where not fitted, m and rad.
    alarm : float
        Probability of a false alarm that one test may have.

    Notes
    -----
    With residuals r = (I - H) e the information on parameters p that change the readings by J p is
    2 Re(J^H W (I - H) J), W = diag(1 / (2 sd^2)), summed over lines; the statistic of k parameters is
    noncentral chi2 (Kay 1998, Detection Theory, section 6.5). Positions add their stated variance. More
    lines than 400 are thinned evenly.
    """
    used = np.flatnonzero(fit.solution.good)
    if not used.size:
        nothing = np.full(len(body.points), np.nan)
        return Detectable(nothing, nothing.copy(), nothing.copy())
    pick = used[np.unique(np.linspace(0, len(used) - 1, _MOST_LINES).round().astype(int))]
    share = len(used) / len(pick)
    weight = 0.5 / fit.at(pick)[1] ** 2
    inverse = packed.unpack(fit.solution.inverse[:, pick], fit.beams.basis.shape[1])
    count = len(body.points)
    gain, angle, shift = (np.full(count, np.nan) for _ in range(3))
    channels: dict[str, list[int]] = {}
    for channel, point in enumerate(body.points):
        channels.setdefault(point, []).append(channel)
    for own in map(np.array, channels.values()):
        kept = _kept(fit.beams.basis[own], weight[own], inverse)
        turns = q[pick, 3:]
        local = q[pick, :3] + np.cross(turns, body.positions_mm[own[0]] * 1e-3)
        for place, channel in enumerate(own):
            alone = 2.0 * share * kept[:, place, place]
            beam = body.directions[channel]
            along = local @ beam
            gain[channel] = _least(np.array([[np.sum(alone * np.abs(along) ** 2)]]), alarm)
            across = local @ _across(beam)
            angle[channel] = _least(np.real(np.einsum("f,fi,fj->ij", alone, across.conj(), across)), alarm)
        slopes = np.stack([np.cross(beam, turns) for beam in body.directions[own]], axis=1)
        about = (
            2.0 * share * np.real(np.einsum("fai,fab,fbj->ij", slopes.conj(), kept, slopes, optimize=True))
        )
        shift[own] = _least(about, alarm, np.nan_to_num(body.position_sd_mm[own[0]]) * 1e-3)
    return Detectable(gain, angle, shift)


def _kept(basis: Array, weight: Array, inverse: Array) -> Array:
    """Return W (I - H) of some channels, (freq, channel, channel)."""
    scaled = basis[None] * weight.T[:, :, None]
    taken = scaled @ inverse @ scaled.transpose(0, 2, 1)
    whole = np.zeros_like(taken)
    places = np.arange(len(basis))
    whole[:, places, places] = weight.T
    return np.asarray(whole - taken)


def _across(direction: Array) -> Array:
    """Return two unit vectors square to a direction and to each other, as columns (3, 2)."""
    first = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(direction, first)])


def _least(information: Array, alarm: float, prior: float = 0.0) -> float:
    """Return the size of a fault along its hardest direction; NaN where there is no information."""
    from scipy.special import chdtri, chndtrinc

    size = len(information)
    weakest = float(np.linalg.eigvalsh(information)[0])
    strongest = float(np.max(np.diag(information)))
    if not weakest > 1e-12 * strongest:
        return float("nan")
    needed = float(chndtrinc(float(chdtri(size, alarm)), size, 1.0 - POWER))
    return float(np.sqrt(needed * (1.0 / weakest + prior**2)))
