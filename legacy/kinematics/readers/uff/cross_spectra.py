"""Frequency responses from the cross and auto spectra of a universal file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legacy.kinematics.readers.uff.coherence import MOST_COHERENCE
from legacy.kinematics.readers.uff.functions import (
    AUTO,
    COHERENCE,
    CROSS,
    FRF,
    TRANSMISSIBILITY,
    Axis,
    Function,
    only_alike,
)
from legacy.kinematics.readers.uff.motion_functions import ORDERS
from legacy.kinematics.readers.unit_labels import is_none, motion_unit, plain
from legacy.stapeskit.faults import Fault

_RATE_POWER = re.compile(r"(?P<unit>\w*[a-z])2/s(?P<order>2|4)")
_POWER = re.compile(r"\(?(?P<unit>.+?)\)?(?:2|\*\(?(?P=unit)\)?)")


@dataclass(frozen=True)
class _Pair:
    """A cross spectrum with the auto spectrum of its reference, and that of its response if there is one."""

    cross: Function
    reference: Function
    response: Function | None


def from_cross_spectra(
    functions: Sequence[Function], file: str, faults: list[Fault]
) -> tuple[list[Function], set[int]]:
    """Make frequency responses of cross spectra whose reference has an auto spectrum.

    Parameters
    ----------
    functions : sequence of Function
        All of a file.
    faults : list of str
        Cross spectra that contradict the auto spectra are added to it.

    Returns
    -------
    made : list of Function
        Of type 4, and where the auto spectrum of the response is there too its coherence of type 6.
    used : set of int
        Numbers of the datasets that went into them.

    Notes
    -----
    H1 = Gyx / Gxx with Gyx = E[Y X*] and coherence |Gyx|^2 / (Gxx Gyy) (Bendat and Piersol 2010, Random Data,
    section 6.1). Scale and window are those of both spectra alike and cancel.
    """
    known = {_ends(function) for function in functions if function.kind in (FRF, TRANSMISSIBILITY)}
    responses: list[Function] = []
    used: set[int] = set()
    for cross in functions:
        if cross.kind != CROSS or cross.real or _ends(cross) in known:
            continue
        pair = _pair(cross, functions)
        if pair is None:
            continue
        axes = _axes(pair)
        if axes is None:
            continue
        used |= {part.place for part in (cross, pair.reference, pair.response) if part is not None}
        auto = pair.reference.y.real
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            value = np.where(auto > 0.0, cross.y / np.where(auto > 0.0, auto, 1.0), np.nan)
        response = replace(cross, kind=FRF, y=value, ordinate=axes[0], denominator=axes[1])
        responses.append(response)
        if pair.response is None:
            continue
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            coherence = np.abs(cross.y) ** 2 / (auto * pair.response.y.real)
        values = coherence[np.isfinite(coherence)]
        if values.size and np.max(values) > MOST_COHERENCE:
            where = f"{file}, datasets {cross.place}, {pair.reference.place} and {pair.response.place}"
            got = f"a coherence of {np.max(values):.3g}"
            step = "Export all as power spectra of one scale, or export frequency responses"
            faults.append(Fault("cross and auto spectra", "of one scale", got, where, step))
            continue
        coherence = np.clip(coherence, 0.0, 1.0)
        responses.append(replace(cross, kind=COHERENCE, y=coherence.astype(complex), real=True))
    return responses, used


def _ends(function: Function) -> tuple[object, ...]:
    """Return response, reference and load case of a function of two points."""
    return (
        *(function.node, function.entity if function.node == 0 else "", function.direction),
        *(function.reference_node, function.reference_direction, function.load_case),
    )


def _pair(cross: Function, functions: Sequence[Function]) -> _Pair | None:
    """Find the auto spectra of a cross spectrum; None without a single one of the reference."""
    reference = _find_auto_spectrum(cross, cross.reference_node, cross.reference_direction, functions)
    response = _find_auto_spectrum(cross, cross.node, cross.direction, functions)
    if reference is None or reference is response:
        return None
    return _Pair(cross, reference, response)


def _find_auto_spectrum(
    cross: Function, node: int, direction: int, functions: Sequence[Function]
) -> Function | None:
    key = (AUTO, node, abs(direction), cross.load_case)
    autos = (f for f in functions if (f.kind, f.node, abs(f.direction), f.load_case) == key)
    return only_alike(autos, cross)


def _axes(pair: _Pair) -> tuple[Axis, Axis] | None:
    """Return what response and reference are: by their auto spectra, else by the cross spectrum itself."""
    reference = _linear(pair.reference.ordinate)
    if reference is None:
        return None
    response = _numerator(pair.cross.ordinate, reference.unit)
    if pair.response is not None:
        response = _linear(pair.response.ordinate)
    if response is None:
        return None
    motion = None if is_none(response.unit) else motion_unit(response.unit)
    if motion is None and (response.kind not in ORDERS or not is_none(response.unit)):
        return None
    return response, reference


def _numerator(axis: Axis, reference: str) -> Axis | None:
    """Return the axis of a response from that of a cross spectrum, whose unit is a product."""
    label = plain(axis.unit)
    if is_none(label):
        return axis
    for end in (f"*{plain(reference)}", f".{plain(reference)}"):
        if label.endswith(end):
            return replace(axis, unit=label.removesuffix(end).strip("()"))
    return None


def _linear(axis: Axis) -> Axis | None:
    """Return the axis of a signal from that of its auto spectrum; None when its unit is no power.

    ``(m/s)^2``, ``m2/s2`` and ``V2`` lose their power; ``m/s2`` is none, it is an acceleration.
    """
    label = plain(axis.unit)
    if is_none(label):
        return axis
    rate = _RATE_POWER.fullmatch(label)
    match = _POWER.fullmatch(label)
    if rate is not None:
        unit = f"{rate['unit']}/s" + ("" if rate["order"] == "2" else "2")
    elif match is None or motion_unit(label) is not None:
        return None
    else:
        unit = match["unit"]
    motion = motion_unit(unit)
    if axis.kind in ORDERS and (motion is None or motion.order != ORDERS[axis.kind]):
        return None
    return replace(axis, unit=unit)
