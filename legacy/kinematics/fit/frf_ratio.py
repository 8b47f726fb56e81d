"""Frequency responses: all motions per unit of one of them, with the covariance of the ratio."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.calibrated import calibrated
from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.arrays import ComplexArray
from legacy.stapeskit.faults import Fault
from legacy.stapeskit.option_names import named
from legacy.stapeskit.records.motion import RigidMotion, SharedErrors
from legacy.stapeskit.records.motion_files import standard_deviation
from legacy.stapeskit.warnings import Notice

_LEAST_SNR: float = calibrated("frf_ratio.least_signal_to_noise")
# Lines at a time: a few MB of covariances.
_LINES = 2048
# Up to here the second order in the noise of the reference is added: beyond, no order suffices.
_MOST_SECOND = 1.0
# Stretches of lines that are named.
_NAMED = 5


def parse_reference(text: str, bodies: tuple[str, ...], dof: tuple[str, ...]) -> tuple[int, int]:
    """Read ``BODY:DOF`` and return the positions of both.

    Raises
    ------
    KinematicsError
        The form is another, there is no such body, or the degree of freedom is not fitted.
    """
    body, _, name = text.rpartition(":")
    if body not in bodies or name not in dof:
        raise KinematicsError(
            Fault(
                "{reference}",
                f"BODY:DOF with a body out of {', '.join(bodies)} and a fitted degree of freedom "
                f"out of {', '.join(dof)}",
                text,
                next_step=f"Write for example {{reference}} {bodies[-1]}:{dof[0]}",
            )
        )
    return bodies.index(body), dof.index(name)


def per_reference(motion: RigidMotion, reference: str) -> RigidMotion:
    """Divide every motion by the reference motion of its run and line.

    Parameters
    ----------
    motion : RigidMotion
        Absolute displacements.
    reference : str
        ``BODY:DOF``.

    Returns
    -------
    RigidMotion
        With the joint covariance of all bodies, (run, freq, body*dof, body*dof).

    Raises
    ------
    KinematicsError
        The reference names no body or no fitted degree of freedom of the motion.

    Notes
    -----
    H = q / q_ref is holomorphic: dH = (dq - H dq_ref) / q_ref, so the complex covariance goes over as
    J C J^H; noise common to all motions of a line cancels. That is first order in the noise of the reference.
    To second order, an error n of the reference r makes n / r (1 - n / r) of the ratio, whose mean square is
    larger by 1 + 2 var(n) / |r|^2 over the stated one, which counts for the part that the reference adds.
    Lines where the reference is less than 10 times its noise (its zero crossings) are named in a notice.
    """
    body, place = parse_reference(reference, motion.bodies, motion.dof)
    if motion.common_sd is not None:
        motion = motion.with_common_noise(np.zeros(1))
    runs, bodies, lines, n = motion.q.shape
    ref = motion.q[:, body, :, place]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = motion.q / ref[:, None, :, None]
    own = ratio[:, body, :, place]
    own[np.isfinite(own)] = 1.0
    covariance = np.empty((runs, lines, bodies * n, bodies * n), dtype=complex)
    for run in range(runs):
        for start in range(0, lines, _LINES):
            part = slice(start, start + _LINES)
            alone = motion.covariance[run, :, part]
            covariance[run, part] = _join_covariance(alone, ratio[run, :, part], ref[run, part], body, place)
    shared = None if motion.shared is None else _shared_errors(motion.shared, ratio, ref, body, place)
    notices = (
        *motion.notices,
        *_missing_reference_notices(motion, ref, reference),
        *_noisy_reference_notices(motion, ref, body, place, reference),
    )
    ratio[~np.isfinite(ratio)] = np.nan
    return replace(
        motion, q=ratio, covariance=covariance, reference=reference, shared=shared, notices=notices
    )


def _join_covariance(
    own: ComplexArray, ratio: ComplexArray, ref: ComplexArray, body: int, place: int
) -> ComplexArray:
    """Return the joint covariance of ratios, (freq, body*dof, body*dof).

    ``own`` is (body, freq, dof, dof), ``ratio`` (body, freq, dof). With c the column of the reference,
    |q_ref|^2 C' = C - H c^H - c H^H + H var(q_ref) H^H. NaN where a motion or its noise is not known.
    """
    bodies, lines, n = ratio.shape
    flat = ratio.transpose(1, 0, 2).reshape(lines, bodies * n)
    missing = ~np.isfinite(flat)
    h = np.where(missing, 0.0, flat)
    joint = np.zeros((lines, bodies * n, bodies * n), dtype=complex)
    for number in range(bodies):
        part = slice(number * n, (number + 1) * n)
        known = np.isfinite(own[number])
        joint[:, part, part] = np.where(known, own[number], 0.0)
        missing[:, part] |= ~np.all(known, axis=(1, 2))[:, None]
    at = body * n + place
    missing |= missing[:, at, None]
    column = joint[:, :, at].copy()
    variance = column[:, at].real[:, None, None]
    cross = h[:, :, None] * column.conj()[:, None, :]
    joint -= cross
    joint -= cross.conj().transpose(0, 2, 1)
    joint += h[:, :, None] * variance * h.conj()[:, None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        second = np.minimum(2.0 * variance / (np.abs(ref) ** 2)[:, None, None], _MOST_SECOND)
        h[:, at] = 0.0
        joint += second * variance * h[:, :, None] * h.conj()[:, None, :]
        joint /= (np.abs(ref) ** 2)[:, None, None]
    joint[missing[:, :, None] | missing[:, None, :]] = np.nan
    return joint


def _shared_errors(
    shared: SharedErrors, ratio: ComplexArray, ref: ComplexArray, body: int, place: int
) -> SharedErrors:
    moved = shared.derivatives[:, :, body, :, place]
    with np.errstate(divide="ignore", invalid="ignore"):
        derivatives = (shared.derivatives - ratio[None] * moved[:, :, None, :, None]) / ref[
            None, :, None, :, None
        ]
    return SharedErrors(shared.names, shared.covariance, derivatives)


def _missing_reference_notices(motion: RigidMotion, ref: ComplexArray, reference: str) -> list[Notice]:
    """Name the lines at which bodies have a motion and the reference has none: no ratio is left of them."""
    moved = np.any(np.all(np.isfinite(motion.q), axis=3), axis=1)
    lost = np.asarray(moved & ~np.isfinite(ref))
    if not np.any(lost):
        return []
    text = (
        f"the reference {reference} has no motion at {int(np.sum(lost))} of {ref.size} lines where other "
        f"bodies have one, {_places(motion, lost)}: no response is stated there. Measure it there too, or "
        f"leave {named('reference')} out."
    )
    return [Notice("reference_missing", text)]


def _noisy_reference_notices(
    motion: RigidMotion, ref: ComplexArray, body: int, place: int, reference: str
) -> list[Notice]:
    sd = standard_deviation(motion)[:, body, :, place]
    with np.errstate(invalid="ignore"):
        weak = np.abs(ref) < _LEAST_SNR * sd
    count = int(np.sum(weak))
    if count == 0:
        return []
    text = (
        f"the reference {reference} is less than {_LEAST_SNR:.0f} times its noise at {count} of {ref.size} "
        f"lines, {_places(motion, weak)}; the stated covariance of the ratio is widened there, and good down "
        "to three times. Leave these lines out of a fit, or take a reference that is not near zero there."
    )
    return [Notice("reference_noisy", text)]


def _places(motion: RigidMotion, chosen: NDArray[np.bool_]) -> str:
    """Return the frequencies of chosen lines (run, freq), run by run where there are several."""
    several = len(motion.runs) > 1
    return "; ".join(
        f"{_ranges(motion.freq_hz, chosen[run])}{f' in run {name}' if several else ''}"
        for run, name in enumerate(motion.runs)
        if np.any(chosen[run])
    )


def _ranges(freq_hz: NDArray[np.float64], weak: NDArray[np.bool_]) -> str:
    """Name the stretches of lines, the widest first when there are many."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], weak.astype(np.int8), [0]])))
    pairs = sorted(zip(edges[::2], edges[1::2] - 1, strict=True), key=lambda pair: pair[0] - pair[1])
    listed = [
        f"{freq_hz[start]:.5g} Hz" if start == stop else f"{freq_hz[start]:.5g} to {freq_hz[stop]:.5g} Hz"
        for start, stop in sorted(pairs[:_NAMED])
    ]
    more = f" and {len(pairs) - _NAMED} stretches more" if len(pairs) > _NAMED else ""
    return ", ".join(listed) + more
