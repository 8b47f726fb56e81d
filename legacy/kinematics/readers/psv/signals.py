"""Values of motion from the columns of a text export: complex, with axis and unit; which quantity is used."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.psv.text_blocks import Block, value_of
from legacy.kinematics.readers.recording import QUANTITIES, from_parts, from_polar, scaled, unknown_vector
from legacy.kinematics.readers.text import shown
from legacy.kinematics.readers.unit_labels import MotionUnit, is_none, motion_unit, phase_scale
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.faults import Fault, Place, collect_faults, raise_all
from legacy.stapeskit.frames import axis_vector
from legacy.stapeskit.warnings import Notice

_PARTS = {
    "re": re.compile(r"^(real|re|realteil|réel|réelle)\b", re.IGNORECASE),
    "im": re.compile(r"^(imag|imaginary|im|imaginär|imaginärteil|imaginaire)\b", re.IGNORECASE),
    "amp": re.compile(r"^(magnitude|amplitude|betrag|mag|module)\b", re.IGNORECASE),
    "phase": re.compile(r"^phase\b", re.IGNORECASE),
}
_AXIS = re.compile(r"(?:^|[\s(_])([+-]?)([XYZ])\s*$", re.IGNORECASE)


@dataclass(frozen=True)
class Signal:
    """Complex values of one axis of a block: axis ``x``, ``-y`` ... or empty, unit, values (rows,) in SI."""

    axis: str
    unit: MotionUnit
    value: ComplexArray


def signals(block: Block) -> list[Signal]:
    """Pair the columns of a block to complex values.

    Raises
    ------
    KinematicsError
        Amplitudes without phase, amplitudes in dB, a real part without an imaginary part, a unit that is no
        motion, or no column of values at all.
    """
    pairs: dict[str, dict[str, int]] = {}
    for place, name in enumerate(block.columns):
        part = next((part for part, pattern in _PARTS.items() if pattern.match(name)), None)
        if part is not None:
            match = _AXIS.search(name)
            axis = "" if match is None else match[1].replace("+", "") + match[2].lower()
            pairs.setdefault(axis, {})[part] = place
    columns: list[Signal] = []
    faults: list[Fault] = []
    unknown: dict[str, list[str]] = {}
    for axis, parts in pairs.items():
        with collect_faults(faults):
            first, value = _value_of(block, axis, parts)
            label = block.units[first]
            unit = None if is_none(label) else motion_unit(label)
            if unit is None:
                unknown.setdefault(label, []).append(axis)
            else:
                columns.append(Signal(axis, unit, scaled(value, unit.scale)))
    faults += [_unit_fault(label, axes, block.where) for label, axes in unknown.items()]
    raise_all(KinematicsError, faults)
    if not columns:
        step = "Export Real & Imag., or Magnitude & Phase"
        expected = "columns of real and imaginary part, or magnitude and phase"
        raise KinematicsError.of(
            "the table",
            expected,
            shown(", ".join(block.columns)) if block.columns else "no names",
            block.where,
            step,
        )
    return columns


def _unit_fault(label: str, axes: list[str], where: Place | str) -> Fault:
    """Return the fault of axes whose unit is not one of motion."""
    named = [axis for axis in axes if axis]
    of_axes = f" of ax{'e' if len(named) > 1 else 'i'}s {', '.join(named)}" if named else ""
    expected = "m, mm, um, nm, m/s, mm/s, um/s, m/s2, g [per unit of a reference]"
    step = "Export velocity or displacement on a linear scale, not in dB"
    return Fault(f"the unit{of_axes}", expected, shown(label) if label else "none", where, step)


def _value_of(block: Block, axis: str, parts: Mapping[str, int]) -> tuple[int, ComplexArray]:
    """Return the column that gives the unit of an axis, and its complex values in that unit."""
    of_axis = f" of axis {axis}" if axis else ""
    if {"re", "im"} <= set(parts):
        first, second = parts["re"], parts["im"]
        value = from_parts(block.numbers[:, first], block.numbers[:, second])
        if block.units[first] != block.units[second]:
            got = f"{shown(block.units[first])} and {shown(block.units[second])}"
            raise KinematicsError.of(
                f"the values{of_axis}", "in one unit", got, block.where, "Export it again"
            )
    elif {"amp", "phase"} <= set(parts):
        first, second = parts["amp"], parts["phase"]
        label = block.units[second]
        turn = phase_scale("deg" if label.strip().lower() == "grad" else label)  # degrees in German
        if turn is None:
            got = shown(label) if label.strip() else "none"
            raise KinematicsError.of(
                "the unit of the phase", "degrees or rad", got, block.where, "Export it again"
            )
        value = from_polar(block.numbers[:, first], block.numbers[:, second], turn)
    else:
        names = {"re": "real part", "im": "imaginary part", "amp": "magnitude", "phase": "phase"}
        got = " and ".join(names[part] for part in parts) + " alone"
        step = "Export Real & Imag., or Magnitude & Phase: motion cannot be computed without its phase"
        expected = "real and imaginary part, or magnitude and phase"
        raise KinematicsError.of(f"the values{of_axis}", expected, got, block.where, step)
    return first, value


def frequency_hz(text: str, where: Place | str) -> float:
    """Read ``1000 Hz`` or ``1,5 kHz``.

    Raises
    ------
    KinematicsError
        Another unit or no number.
    """
    match = re.fullmatch(r"\s*([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*(m|k|M)?Hz\s*", text)
    value = None if match is None else value_of(match[1])
    if match is None or value is None:
        raise KinematicsError.of("the frequency", "a number in Hz", shown(text), where, "Export it again")
    return float(value) * {"m": 1e-3, None: 1.0, "k": 1e3, "M": 1e6}[match[2]]


def chosen_order(orders: Iterable[int], name: str) -> tuple[int, list[Notice]]:
    """Return the quantity to use, velocity first, and a notice where there are several."""
    ranked = sorted(set(orders), key=lambda order: (order != 1, order))
    if len(ranked) == 1:
        return ranked[0], []
    listed = " and ".join(QUANTITIES[order] for order in ranked)
    text = f"{name} holds {listed}: {QUANTITIES[ranked[0]]} is used."
    return ranked[0], [Notice("quantity_chosen", text)]


def axes_notice(name: str) -> Notice:
    """Warn that x, y, z of a point are linear combinations of its beam readings."""
    text = (
        f"{name} holds x, y, z computed from several beams: their noise is correlated, and larger across the "
        "beams than along them; sd and verdicts, which take channels as independent, are approximate. "
        "Export the single heads with their directions where possible."
    )
    return Notice("axes_from_beams", text)


def beam_of(axis: str) -> Array:
    """Return the unit vector of ``x``, ``-y`` ..., NaN for an empty name."""
    direction = axis_vector(axis)
    return unknown_vector() if direction is None else direction
