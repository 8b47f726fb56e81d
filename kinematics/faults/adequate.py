"""Do the faults that were named account for the misfit, or does the body bend where they were sought?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinematics.faults.findings import Finding
from kinematics.faults.packed.compact import Compact
from kinematics.faults.search import Search

Array = NDArray[np.float64]
# What may remain: so many standard deviations of the energy of noise, or this share of what there was.
_SURE, _SHARE = 6.0, 0.02
# From so many residual directions on, a misfit of one channel alone is that channel's.
_MANY = 30


def corrected(data: Compact, findings: list[Finding]) -> Compact:
    """Return the data with every finding undone by its estimate, all channels kept."""
    for finding in findings:
        if finding.kind == "noise":
            data = data.weighted(finding.channels, finding.size)
        elif finding.fit is not None:
            data = finding.fit.fault.undone(data, finding.fit.parameters)
    return data.repacked()


def account_for_it(first: Search, after: Search, findings: list[Finding]) -> bool:
    """Tell whether findings, undone by their estimates, leave hardly more than noise.

    To leave a channel out removes whatever it holds. With few channels a motion that is not rigid shows in
    one or two of them, and a factor that fits it partly is no explanation.

    Parameters
    ----------
    first, after : Search
        Before anything was undone, and with all findings undone.
    findings : list of Finding

    Notes
    -----
    The residual energy of n complex values of unit variance is n +- sqrt(n). A single channel is believed
    whose residuals are its motion times a factor with any course over the measurement, or that stands alone
    among many: a body that bends shows in several of these, a beam that reads motion of its own in one.
    """
    scale = min(first.scale, after.scale)
    before, _ = _excess(first, scale)
    left, spread = _excess(after, scale)
    if left < _SURE * spread or left < _SHARE * before:
        return True
    only = findings[0]
    if len(findings) > 1 or len(only.channels) > 1:
        return False
    alone = len(first.live) - first.state.span.shape[1] >= _MANY
    return alone or _own_course(first, only.channels[0], scale)


def _excess(search: Search, scale: float) -> tuple[float, float]:
    """Return the residual energy beyond noise of this variance, and its standard deviation."""
    held = [search.state.e, search.rest]
    free = len(search.live) - search.state.span.shape[1]
    number = float(free * sum(part.shape[1] for part in held))
    energy = sum(float(np.sum(np.abs(part) ** 2)) for part in held)
    return energy - scale * number, scale * float(np.sqrt(number))


def _own_course(search: Search, channel: int, scale: float) -> bool:
    """Tell whether a factor of its own in every segment accounts for the residuals of a channel."""
    state, data = search.state, search.data
    root = np.sqrt(max(1.0 - search.h[channel], 1e-3))
    residual = state.plain(state.e)[channel] / root
    motion = data.a[channel] * (data.beams.basis[channel] @ state.z)
    whole, left, number = 0.0, 0.0, 0
    for part in np.unique(data.part):
        own = data.part == part
        x, e = motion[own], residual[own]
        energy = float(np.sum(np.abs(e) ** 2))
        whole += energy
        left += energy - abs(np.vdot(x, e)) ** 2 / max(float(np.sum(np.abs(x) ** 2)), 1e-300)
        number += len(e) - 1
    left -= scale * number
    return left < _SURE * scale * np.sqrt(max(number, 1)) or left < _SHARE * whole
