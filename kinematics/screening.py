"""Set values aside that hold nothing: channels of zeros where the body moves, and channels without any
value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinematics.fit.beams import beam_set, observability
from kinematics.fit.rigid_fit import fit_lines
from kinematics.measurement import BodyChannels, Measurement
from stapeskit.faults import Fault, raise_all
from stapeskit.spatial import DOF_NAMES, dof_indices, point_rows
from stapeskit.warnings import Notice

_DETERMINED = (
    1e-3  # weakest observability, over the strongest, by which channels that read zero are classified
)
_SURE = 3.0  # predicted motion over what the fit of the others leaves


@dataclass(frozen=True)
class Screened:
    """A measurement with the values that are not to be used set to NaN, and why.

    Attributes
    ----------
    measurement : Measurement
    unused : dict of (run, body, channel) to str
        ``zeros`` or ``unused``.
    notices : tuple of Notice
    """

    measurement: Measurement
    unused: dict[tuple[int, int, int], str]
    notices: tuple[Notice, ...] = ()


def screen(measurement: Measurement, dof: tuple[str, ...]) -> Screened:
    """Set aside values that are exactly zero although the body moves there.

    A channel of zeros is believed when the other channels show that nothing moves along its beam, or when
    they cannot show it.

    Raises
    ------
    StapeskitError
        A body has no usable value, or reads zero throughout without a stated noise.
    """
    raise_all(_empty(measurement))
    unused: dict[tuple[int, int, int], str] = {}
    texts: list[str] = []
    bodies = []
    dropped = False
    for number, body in enumerate(measurement.bodies):
        value = body.value
        zero = value == 0.0
        if not zero.any() and np.isfinite(value.real).all():
            bodies.append(body)
            continue
        drop = np.zeros(value.shape, dtype=bool)
        for run, name in enumerate(measurement.runs):
            where = f" in run {name}" if len(measurement.runs) > 1 else ""
            usable = _usable(body, run)
            empty = np.flatnonzero(~usable.any(axis=1)).tolist()
            unused |= {(run, number, channel): "unused" for channel in empty}
            still = np.all(zero[run] | ~usable, axis=1) & np.any(zero[run], axis=1)
            dead = np.flatnonzero(still).tolist()
            if dead and _moves(body, run, dead, dof):
                drop[run, dead] = True
                unused |= {(run, number, channel): "zeros" for channel in dead}
                listed = ", ".join(body.channel_name(channel) for channel in dead[:4])
                more = f" and {len(dead) - 4} more" if len(dead) > 4 else ""
                texts.append(f"channels {listed}{more}{where} read zero throughout while the body moves")
            some = zero[run] & ~drop[run]
            some[dead] = False
            if some.any() and not np.any(np.all(some, axis=1)):
                drop[run] |= some
                texts.append(f"{int(some.sum())} single values of body {body.body}{where} are exactly zero")
        dropped |= bool(drop.any())
        bodies.append(replace(body, value=np.where(drop, np.nan, value)) if drop.any() else body)
    step = "these values were not used (missing points are often exported as zero)"
    notices = (Notice("zero_rows", f"{'; '.join(texts)}; {step}."),) if texts else ()
    whole = replace(measurement, bodies=tuple(bodies)) if dropped else measurement
    return Screened(whole, unused, notices)


def _empty(measurement: Measurement) -> list[Fault]:
    """List the bodies that hold nothing to fit: no usable value, or zeros throughout and no sd."""
    faults = []
    file = ", ".join(path.name for role, path in measurement.inputs.items() if role.startswith("ldv"))
    for body in measurement.bodies:
        thing = f"the values of body {body.body}"
        usable = [_usable(body, run) for run in range(len(measurement.runs))]
        if not any(np.any(one) for one in usable):
            step, got = (
                "Check the export, or leave the rows of this body out",
                "empty or NaN cells throughout",
            )
            faults.append(Fault(thing, "numbers in at least one row", got, file, step))
            continue
        for run, name in enumerate(measurement.runs):
            still = np.any(usable[run]) and not np.any(body.value[run][usable[run]])
            if still and (body.sd is None or body.relative):
                where = f"run {name}" if len(measurement.runs) > 1 else ""
                step = "Give an sd column if the body stood still, or leave its rows out"
                expected = "other than zero in some rows, or given with their sd"
                faults.append(Fault(thing, expected, "zeros throughout", where, step))
    return faults


def _usable(body: BodyChannels, run: int) -> NDArray[np.bool_]:
    """Return which values of a run (c, L) are numbers, as are their sd."""
    there = np.isfinite(body.value[run])
    return there if body.sd is None else np.asarray(there & np.isfinite(body.sd[run]))


def _moves(body: BodyChannels, run: int, dead: Sequence[int], dof: tuple[str, ...]) -> bool:
    """Return whether the other channels predict motion along the beams that read zero."""
    live = np.setdiff1d(np.arange(len(body.points)), dead)
    names = tuple(name for name in DOF_NAMES if name in dof)
    places, beams = body.arms_m[live], body.directions[live]
    if len(live) < len(names) or observability(places, beams, names)[-1] < _DETERMINED:
        return False
    value = body.value[run, live]
    fit = fit_lines(
        beam_set(body.body, places, beams, names), value, np.ones((1, 1)), np.ones(value.shape[1])
    )
    good = fit.solution.good
    if not good.any():
        return False
    left = float(np.sqrt(np.nanmean(np.abs(fit.residual(np.flatnonzero(good))) ** 2)))
    rows = point_rows(body.arms_m[list(dead)], body.directions[list(dead)])[:, dof_indices(names)]
    expected = np.sqrt(np.mean(np.abs(rows @ fit.q[good].T) ** 2, axis=1))
    size = float(np.sqrt(np.nanmean(np.abs(value[:, good]) ** 2)))
    return bool(np.all(expected > max(_SURE * left, 1e-6 * size)))
