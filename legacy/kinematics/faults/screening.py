"""Find channels that hold nothing: rows of zeros where the body moves, and channels without any value."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.fit.beams import beam_set, observability
from legacy.kinematics.fit.line_noise import blocks
from legacy.kinematics.fit.rigid_fit import fit_lines
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.stapeskit.faults import Fault
from legacy.stapeskit.spatial import DOF_NAMES, dof_indices, point_rows
from legacy.stapeskit.warnings import Notice

# Weakest observability of a motion, relative to the strongest, by which channels that read zero are judged.
_DETERMINED = 1e-3


@dataclass(frozen=True)
class Screened:
    """A body with the values that are not to be used set to NaN, and why.

    Attributes
    ----------
    body : BodyChannels
    unused : tuple of dict, (run,)
        ``zeros`` or ``unused`` by channel.
    notices : tuple of Notice
    """

    body: BodyChannels
    unused: tuple[dict[int, str], ...]
    notices: tuple[Notice, ...]


def is_whole(body: BodyChannels) -> bool:
    """Return, in one pass, whether all values and sd are finite and no value is exactly zero.

    Such a body has nothing to be screened for.
    """
    for run, value in enumerate(body.displacement):
        sd = np.ones((1, 1)) if body.sd is None else body.sd[run]
        sd = sd[tuple(slice(0, 1) if stride == 0 else slice(None) for stride in sd.strides)]
        parts = (value[:, part] for part in blocks(*value.shape))
        if not np.all(np.isfinite(sd)):
            return False
        if not all(np.all(np.isfinite(part) & (part != 0.0)) for part in parts):
            return False
    return True


def empty_faults(measurement: Measurement) -> list[Fault]:
    """List the bodies that hold nothing to fit: no usable value, or zeros throughout and no sd."""
    faults = []
    file = ", ".join(path.name for role, path in measurement.inputs.items() if role.startswith("ldv"))
    for body in measurement.bodies:
        thing = f"the values of body {body.body}"
        places = np.ndindex(body.displacement.shape[:2])
        if not any(np.any(_usable(body, place)) for place in places):
            step = "Check the export, or leave the rows of this body out"
            got = "empty or NaN cells throughout"
            faults.append(Fault(thing, "numbers in at least one row", got, file, step))
            continue
        if body.sd is not None and not body.relative:
            continue
        for run, name in enumerate(measurement.runs):
            usable = _usable(body, run)
            if np.any(usable) and not np.any(body.displacement[run][usable]):
                where = f"run {name}" if len(measurement.runs) > 1 else ""
                step = "Give an sd column if the body stood still, or leave its rows out"
                expected = "other than zero in some rows, or given with their sd"
                faults.append(Fault(thing, expected, "zeros throughout", where, step))
    return faults


def _usable(body: BodyChannels, place: Any) -> NDArray[np.bool_]:
    """Return which values at a place, by run, channel and line, are numbers, as are their sd."""
    there = np.isfinite(body.displacement[place])
    return there if body.sd is None else np.asarray(there & np.isfinite(body.sd[place]))


def screen_values(body: BodyChannels, runs: tuple[str, ...], dof: tuple[str, ...]) -> Screened:
    """Set aside values that are exactly zero although the body moves there.

    A channel of zeros is believed when the other channels say that nothing moves along its beam, or when
    they cannot tell without it.
    """
    value = body.displacement
    zero = value == 0.0
    unused: list[dict[int, str]] = []
    texts: list[str] = []
    drop = np.zeros(value.shape, dtype=bool)
    for run, name in enumerate(runs):
        where = f" in run {name}" if len(runs) > 1 else ""
        # A channel whose first value is a number holds something.
        first = _usable(body, (run, slice(None), 0)) & ~zero[run, :, 0]
        doubtful = np.flatnonzero(~first).tolist()
        marks = {c: "unused" for c in doubtful if not np.any(_usable(body, (run, c)))}
        dead = [c for c in doubtful if np.all(zero[run, c] | np.isnan(value[run, c].real))]
        dead = [c for c in dead if np.any(zero[run, c])]
        if dead and _moves(body, run, dead, dof):
            drop[run, dead] = True
            marks |= dict.fromkeys(dead, "zeros")
            texts.append(f"{_names(body, dead)}{where} read zero throughout while the body moves")
        elif len(dead) == value.shape[1]:
            texts.append(f"all channels of body {body.body}{where} read zero throughout")
        some = zero[run] & ~drop[run]
        some[dead] = False
        if np.any(some) and not np.any(np.all(some, axis=1)):
            drop[run] |= some
            texts.append(f"{int(np.sum(some))} single values of body {body.body}{where} are exactly zero")
        unused.append(marks)
    if np.any(drop):
        body = replace(body, displacement=np.where(drop, np.nan, value))
    step = "these values were not used (missing points are often exported as zero)"
    step = step if np.any(drop) else "they were kept"
    notices = (Notice("zero_rows", f"{'; '.join(texts)}; {step}."),) if texts else ()
    return Screened(body, tuple(unused), notices)


def _moves(body: BodyChannels, run: int, dead: list[int], dof: tuple[str, ...]) -> bool:
    """Return whether the other channels predict motion along the beams that read zero."""
    live = [c for c in range(len(body.points)) if c not in dead]
    names = tuple(name for name in DOF_NAMES if name in dof)
    places, beams = body.positions_mm[live], body.directions[live]
    if len(live) < len(names) or observability(places * 1e-3, beams, names)[-1] < _DETERMINED:
        return False
    value = body.displacement[run, live]
    fit = fit_lines(beam_set(body.body, places, beams, names), value, np.ones((1, 1)))
    weakest = np.trace(fit.inverse, axis1=1, axis2=2)  # twice the inverse square of singular values
    sure = fit.solution.good & (weakest < 2.0 / _DETERMINED**2)
    if not np.any(sure):
        return False
    used = np.sum(np.isfinite(value[:, sure]))
    left = np.sqrt(np.nansum(np.abs(fit.residual[:, sure]) ** 2) / used)
    rows = point_rows(body.positions_mm[dead] * 1e-3, body.directions[dead])[:, dof_indices(names)]
    expected = np.sqrt(np.mean(np.abs(rows @ fit.q[sure].T) ** 2, axis=1))
    size = np.sqrt(np.nansum(np.abs(value[:, sure]) ** 2) / used)
    return bool(np.all(expected > max(3.0 * left, 1e-6 * size)))


def _names(body: BodyChannels, channels: list[int]) -> str:
    listed = [body.channel_name(c) for c in channels[:4]]
    more = f" and {len(channels) - 4} more" if len(channels) > 4 else ""
    return f"channel{'s' if len(channels) > 1 else ''} {', '.join(listed)}{more}"
