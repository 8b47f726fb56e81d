"""How likely a ligament makes the motion of a structure, given that of its base: with few lines as well.

At low frequencies a ligament carries the structure along with its base, whatever its stiffness: there one
body in rms, or in another range, stands out against all degrees of freedom at once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.proposals.two_bodies import MODEL, Pair

# Undamped resonances of a stapes on its ligament of which the likeliest counts: those of the paper lie from
# 1.7 to 3.9 kHz; the lowest leaves room for a soft ligament, the highest for a stiff one.
_RESONANCES_HZ = (400.0, 800.0, 1600.0, 3200.0)
# Standard deviations of what is not known: viscous loss (twice the damping ratio, at the resonance),
# hysteretic loss, and the errors of positions, beams and gains of either body relative to its motion.
_VISCOUS, _HYSTERETIC, _GEOMETRY = 1.0, 0.1, 0.05
# Lines of each run that are compared: more tell no more of a size that errors of the geometry limit, while
# the noise of the motions, which are regressors as well, biases the fit of many. Of 32 simulated slips at 60
# lines 27 were named with 30, 30 with 20, 32 with 14 and with 10.
_LINES = 15
# Least power of a component, of that of the strongest: keeps what does not move solvable.
_LEAST = 1e-12
_TINY = 1e-300


def log_evidence(pair: Pair, related: bool = True) -> float:
    """Return the logarithm of the probability density of the structure's motion, given that of its base.

    Parameters
    ----------
    pair : Pair
    related : bool
        One ligament joins the two; otherwise any constant matrix does.

    Notes
    -----
    Of w^2 M q_s = (K (1 + i eta) + i w D) (q_s - q_b), each component of q_s - q_b is
    w^2 A q_s - i w B (q_s - q_b) - i C (q_s - q_b) + G q_b with real A = K^-1 M, B and C, and a complex G for
    what the geometry is off. All of them are normal with the stated sd and mean zero, A of (2 pi f)^-2 for a
    resonance f, of rotations over the lever: the evidence of a linear model (MacKay 1992,
    doi:10.1162/neco.1992.4.3.415). Noise of q_s counts (1 + (w / 2 pi f)^2) times, as the mass multiplies it.
    """
    lines = _compare(pair)
    return max(_evidence(pair, lines, resonance, related) for resonance in _RESONANCES_HZ)


def unrelated_evidence(pair: Pair) -> float:
    """Return the same when the two motions have nothing to do with each other.

    Each component is complex normal noise of its own size.
    """
    lines = _compare(pair)
    power = 0.5 * np.mean(np.abs(pair.structure[:, lines] * pair.unit_m) ** 2, axis=(0, 1))
    power = np.maximum(power, max(_LEAST * float(np.max(power)), _TINY))
    return float(-len(pair.runs) * len(lines) * np.sum(np.log(power) + 1.0))


def _compare(pair: Pair) -> NDArray[np.intp]:
    """Return the lines that are compared, evenly spread."""
    lines = pair.complete_lines()
    return lines[np.unique(np.linspace(0, len(lines) - 1, min(len(lines), _LINES)).round().astype(int))]


def _evidence(pair: Pair, lines: NDArray[np.intp], resonance_hz: float, related: bool) -> float:
    size = pair.structure.shape[-1]
    s = (pair.structure[:, lines] * pair.unit_m).reshape(-1, size)
    b = (pair.base[:, lines] * pair.unit_m).reshape(-1, size)
    sd = pair.sd[:, :, lines] * pair.unit_m
    ratio = np.tile(pair.freq_hz[lines] / resonance_hz, len(pair.runs))[:, None]
    power, of_base = np.mean(np.abs(s) ** 2, axis=0), np.mean(np.abs(b) ** 2, axis=0)
    # The noise of the base is scaled to the structure, so that its size does not depend on that of the base.
    share = power / np.maximum(of_base, _TINY)
    noise = (sd[:, 0] ** 2 + sd[:, 1] ** 2 * share).reshape(-1, size)
    noise = noise + 0.5 * MODEL**2 * np.mean(np.abs(s) ** 2, axis=1, keepdims=True)
    floor = max(_LEAST * float(np.max(power)), _TINY)
    variance = np.maximum(noise * (1.0 + ratio**2) ** 2, floor)
    dq, geometry = (s - b, _GEOMETRY * b) if related else (s, b)
    blocks = [ratio**2 * s, -1j * _VISCOUS * ratio * dq, -1j * _HYSTERETIC * dq, geometry, 1j * geometry]
    columns = np.hstack(blocks)
    root = 1.0 / np.sqrt(np.vstack([variance, variance])).T
    rows = np.vstack([columns.real, columns.imag]) * root[:, :, None]
    target = np.vstack([dq.real, dq.imag]).T * root
    gram = np.eye(rows.shape[2]) + rows.swapaxes(1, 2) @ rows
    factor = np.linalg.cholesky(gram)
    explained = np.linalg.solve(factor, (rows.swapaxes(1, 2) @ target[:, :, None]))[:, :, 0]
    logs = np.sum(np.log(root)) - np.sum(np.log(np.diagonal(factor, axis1=1, axis2=2)))
    return float(logs - 0.5 * (np.sum(target**2) - np.sum(explained**2)))
