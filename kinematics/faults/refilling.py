"""Gaps filled by what a fault that was found says of them."""

from __future__ import annotations

from dataclasses import replace

from kinematics.faults.findings import Finding
from kinematics.faults.packed.compact import Compact


def filled_freely(data: Compact) -> bool:
    """Tell whether gaps were filled by rows that were found together with the motion."""
    filled = data.source.filled
    return filled is not None and filled.moved is not filled.z


def refilled(data: Compact, found: Finding) -> Compact:
    """Return the data as measured, with gaps filled by the rows and factors of a fitted fault.

    A fault has few parameters; rows that were found freely carry more noise into the gaps. Of a drift only
    its mean is taken, so that no slope is seen but that of the readings.
    """
    if found.fit is None:
        return data
    parameters = found.fit.parameters.copy()
    if found.kind == "drift":
        parameters[2:] = 0.0
    undone = found.fit.fault.undone(data, parameters).repacked()
    factor = undone.divisor / data.divisor
    y, rest, a = undone.y.copy(), undone.rest.copy(), undone.a.copy()
    for channel in found.channels:
        mean = abs(complex(factor[channel].mean()))
        if not mean > 0.0:
            return data
        y[channel] *= factor[channel, undone.part]
        rest[channel] *= factor[channel, undone.rest_part]
        a[channel] /= mean
    return replace(
        undone,
        y=y,
        rest=rest,
        a=a,
        divisor=data.divisor,
        beams=data.beams,
        arms_m=data.arms_m,
        directions=data.directions,
    )
