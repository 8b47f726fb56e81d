"""What the noise of a reference does to the motion when points were recorded one after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from kinematics.fit.rigid_fit import LineFit
from kinematics.measurement import BodyChannels, Measurement
from kinematics.motion import RigidMotion


def cautious(measured: Measurement, run: int, body: BodyChannels) -> BodyChannels | None:
    """Return a body whose sd hold the shared noise of records in any direction; None when it has none.

    Notes
    -----
    A search for faults that takes the noise of beams for independent would find the beams of one point at
    fault together. As matrices v v^H <= diag(|v_i| sum |v_j|): own noise and that diagonal bound the noise of
    any combination of beams.
    """
    if body.sd is None or body.relative or not any(one.run == run for one in measured.record_noise):
        return None
    sd, changed = body.sd, False
    for one in measured.record_noise:
        channels = [k for k, point in enumerate(body.points) if (body.body, point) in one.points]
        if one.run != run or len(channels) < 2:
            continue
        sd, changed = (sd if changed else sd.copy()), True
        size = np.abs(body.displacement[run, channels])
        others = np.nansum(size, axis=0) - size
        sd[run, channels] = np.sqrt(sd[run, channels] ** 2 + one.sd**2 * size * others)
    return replace(body, sd=sd) if changed else None


def with_record_noise(
    motion: RigidMotion, measured: Measurement, fits: Mapping[tuple[int, int], LineFit]
) -> RigidMotion:
    """Return the motion with the covariance of channels that have a record of the reference in common.

    Parameters
    ----------
    motion : RigidMotion
        Absolute, its covariance from the sd of the channels as if they were independent.
    measured : Measurement
        Its ``record_noise``; the sd of the channels hold the same noise.
    fits : mapping of (run, body) to LineFit

    Notes
    -----
    The motion is q = G v with G = (C / 2) B^T W of the fit, C its covariance, B the beams and W one over the
    squared sd. An error e with E|e|^2 = 2 s^2 that multiplies the readings v of some channels moves it by
    G v e: it adds 2 s^2 (g g^H - sum |v_i|^2 G_i G_i^T), g = sum G_i v_i, to a covariance that holds the
    second sum already.
    """
    if not measured.record_noise:
        return motion
    covariance = motion.covariance.copy()
    for one in measured.record_noise:
        for number, body in enumerate(measured.bodies):
            channels = [k for k, point in enumerate(body.points) if (body.body, point) in one.points]
            if len(channels) < 2 or body.sd is None or body.relative:
                continue
            fit = fits[one.run, number]
            value, sd = body.displacement[one.run, channels], body.sd[one.run, channels]
            used = np.isfinite(value.real) & np.isfinite(sd) & (sd > 0.0)
            weight = np.where(used, 1.0 / np.where(used, sd, 1.0) ** 2, 0.0)
            held = np.where(used, value, 0.0)
            rows = fit.beams.rows[channels]
            half = 0.5 * fit.covariance.real
            gain = np.einsum("fij,cj,cf->fic", half, rows, weight, optimize=True)
            alone = gain * np.abs(held.T)[:, None, :]
            together = np.einsum("fic,cf->fi", gain, held)
            added = together[:, :, None] * together[:, None, :].conj() - alone @ alone.transpose(0, 2, 1)
            covariance[one.run, number] += 2.0 * (one.sd**2)[:, None, None] * added
    return replace(motion, covariance=covariance)
