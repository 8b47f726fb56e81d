"""Frequency responses: all motions per unit of one of them, with the covariance of the ratio."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array, ComplexArray
from stapeskit.faults import StapeskitError
from stapeskit.records.rigid_motion import RigidMotion, SharedErrors
from stapeskit.warnings import Notice

LEAST_SIGNAL_TO_NOISE = 10.0
"""Reference over its noise from which on the covariance of a ratio is right to first order within 2 %."""

_LINES = 2048  # lines at a time: a few MB of covariances
_MOST_HIGHER_ORDERS = 1.0  # up to here the higher orders in the noise of the reference are added
_LISTED = 5  # stretches of lines in a message


def parse_reference(text: str, bodies: tuple[str, ...], dof: tuple[str, ...]) -> tuple[int, int]:
    """Read ``BODY:DOF`` and return the positions of both.

    Raises
    ------
    StapeskitError
        The form is another, there is no such body, or the degree of freedom is not in the fit.
    """
    body, _, name = text.rpartition(":")
    if body not in bodies or name not in dof:
        expected = f"BODY:DOF with a body of {', '.join(bodies)} and a degree of freedom of {', '.join(dof)}"
        step = f"Write for example --reference {bodies[-1]}:{dof[0]}"
        raise StapeskitError.of("--reference", expected, text, next_step=step)
    return bodies.index(body), dof.index(name)


def per_reference(motion: RigidMotion, reference: str) -> RigidMotion:
    """Divide every motion by the reference motion of its run and line.

    ``reference`` is ``BODY:DOF``; the covariance becomes the joint one of all bodies, (run, freq, body*dof,
    body*dof).

    Raises
    ------
    StapeskitError
        As `parse_reference`.

    Notes
    -----
    H = q / q_ref is holomorphic: dH = (dq - H dq_ref) / q_ref, so that the covariance is J C J^H. To third
    order, an error n of the reference r makes n / r (1 - n / r + (n / r)^2) of the ratio, whose mean square
    is larger by 1 + 2 v + 6 v^2 with v = var(n) / |r|^2.
    """
    body, place = parse_reference(reference, motion.bodies, motion.dof)
    runs, bodies, lines, n = motion.q.shape
    ref = motion.q[:, body, :, place]
    covariance = np.empty((runs, lines, bodies * n, bodies * n), dtype=complex)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = motion.q / ref[:, None, :, None]
        own = ratio[:, body, :, place]
        own[np.isfinite(own)] = 1.0
        for run in range(runs):
            for start in range(0, lines, _LINES):
                part = slice(start, start + _LINES)
                alone = motion.covariance[run, :, part]
                covariance[run, part] = _joint(alone, ratio[run, :, part], ref[run, part], body * n + place)
        shared = motion.shared
        if shared is not None:  # maps of one body cannot express the errors of ratios
            moved = shared.derivatives[:, :, body, None, :, place, None]
            change = shared.derivatives - ratio[None] * moved
            shared = SharedErrors(shared.names, shared.covariance, change / ref[None, :, None, :, None])
        moves = np.any(np.all(np.isfinite(motion.q), axis=3), axis=1)
        weak = np.abs(ref) < LEAST_SIGNAL_TO_NOISE * motion.standard_deviation[:, body, :, place]
    ratio[~np.isfinite(ratio)] = np.nan
    lost = (
        moves & ~np.isfinite(ref), "has no motion where other bodies have one",
        "no response is written there. Measure it there too, or leave --reference out.",
    )  # fmt: skip
    noisy = (
        weak, f"is less than {LEAST_SIGNAL_TO_NOISE:.0f} times its noise",
        "the covariance of the ratio is widened there, and good down to three times. Leave these lines "
        "out of a fit, or take a reference that is not near zero there.",
    )  # fmt: skip
    notices = [*motion.notices]
    for chosen, what, step in (lost, noisy):
        if np.any(chosen):
            count = f"at {int(np.sum(chosen))} of {ref.size} lines"
            text = f"the reference {reference} {what}, {count}, {_places(motion, chosen)}; {step}"
            notices.append(Notice("lines_undetermined", text))
    return replace(
        motion, q=ratio, covariance=covariance, reference=reference, shared=shared, notices=tuple(notices)
    )


def _joint(own: ComplexArray, ratio: ComplexArray, ref: ComplexArray, at: int) -> ComplexArray:
    """Return the joint covariance of ratios to motion ``at``, (freq, body*dof, body*dof).

    ``own`` is (body, freq, dof, dof), ``ratio`` (body, freq, dof). NaN where a motion or its noise is not
    known.
    """
    bodies, lines, n = ratio.shape
    h = ratio.transpose(1, 0, 2).reshape(lines, bodies * n)
    joint = np.zeros((lines, bodies * n, bodies * n), dtype=complex)
    missing = ~np.isfinite(h)
    for number in range(bodies):
        part = slice(number * n, (number + 1) * n)
        joint[:, part, part] = np.nan_to_num(own[number])
        missing[:, part] |= ~np.isfinite(own[number]).all(axis=(1, 2))[:, None]
    missing |= missing[:, at, None]
    h = np.where(missing, 0.0, h)
    variance = joint[:, at, at].real[:, None, None]
    change = np.eye(bodies * n) - h[:, :, None] * np.eye(bodies * n)[at]
    joint = change @ joint @ change.conj().transpose(0, 2, 1)
    square = (np.abs(ref) ** 2)[:, None, None]
    h[:, at] = 0.0
    unsure = variance / square
    higher = np.minimum(2.0 * unsure + 6.0 * unsure**2, _MOST_HIGHER_ORDERS)
    joint = (joint + higher * variance * h[:, :, None] * h[:, None].conj()) / square
    return np.where(missing[:, :, None] | missing[:, None, :], np.nan, joint)


def _places(motion: RigidMotion, chosen: NDArray[np.bool_]) -> str:
    """Return the frequencies of chosen lines (run, freq), run by run where there are several."""
    several = len(motion.runs) > 1
    return "; ".join(
        f"{format_stretches(motion.freq_hz, chosen[run])}{f' in run {name}' if several else ''}"
        for run, name in enumerate(motion.runs)
        if np.any(chosen[run])
    )


def format_stretches(freq_hz: Array, chosen: NDArray[np.bool_], most: int = _LISTED) -> str:
    """Write stretches of chosen lines (L,) as frequencies, the widest where there are many."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]])))
    pairs = sorted(zip(edges[::2], edges[1::2] - 1, strict=True), key=lambda pair: pair[0] - pair[1])
    listed = [
        f"{freq_hz[start]:.5g} Hz" if start == stop else f"{freq_hz[start]:.5g} to {freq_hz[stop]:.5g} Hz"
        for start, stop in sorted(pairs[:most])
    ]
    more = f" and {len(pairs) - most} stretches more" if len(pairs) > most else ""
    return ", ".join(listed) + more
