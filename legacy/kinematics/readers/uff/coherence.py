"""The coherence of a frequency response in a universal file: its own function, or from auto spectra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.readers.uff.functions import (
    AUTO,
    COHERENCE,
    FRF,
    PSD,
    TRANSMISSIBILITY,
    Function,
    only_alike,
    same_abscissa,
)
from legacy.stapeskit.arrays import Array

Key = tuple[object, ...]
# A coherence above 1 by more than rounding is none.
MOST_COHERENCE = 1.05


@dataclass(frozen=True)
class Coherences:
    """Coherence functions and auto spectra of a file by their points and directions."""

    coherence: dict[Key, Function] = field(default_factory=dict)
    auto: dict[Key, list[Function]] = field(default_factory=dict)

    def of(self, response: Function, file: str) -> tuple[Array | None, bool]:
        """Return the coherence (n,) of a response, None when unknown, and whether it was computed.

        Raises
        ------
        KinematicsError
            A coherence of other frequencies, or beyond 0 to 1.

        Notes
        -----
        From auto spectra: |H|^2 Gxx / Gyy, which is the coherence for H1 = Gxy / Gxx (Bendat and Piersol
        2010, Random Data, section 6.1).
        """
        if response.kind not in (FRF, TRANSMISSIBILITY):
            return None, False
        where = f"{file}, dataset {response.place}"
        key = place_of(response)
        match = self.coherence.get((*key, *reference_of(response)), self.coherence.get(key))
        if match is not None:
            return _check_stated(match, response, where), False
        computed = self._from_auto(response)
        return computed, computed is not None

    def _from_auto(self, response: Function) -> Array | None:
        own = self._find_auto_spectrum(place_of(response), response.ordinate.kind, response)
        node, direction = response.reference_node, response.reference_direction
        reference = self._find_auto_spectrum(
            (node, "", abs(direction), response.load_case), response.denominator.kind, response
        )
        if own is None or reference is None or own is reference:
            return None
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.abs(response.y) ** 2 * reference.y.real / own.y.real
        good = ratio[np.isfinite(ratio)]
        if good.size == 0 or np.any(good < 0.0):
            return None
        # More than 1: an H2 estimate, or spectra of another scale; they cannot be distinguished.
        return None if np.max(good) > MOST_COHERENCE else np.clip(ratio, 0.0, 1.0)

    def _find_auto_spectrum(self, key: Key, kind: int, response: Function) -> Function | None:
        """Return the one auto spectrum of a quantity at a point and direction."""
        autos = (function for function in self.auto.get(key, []) if function.ordinate.kind == kind)
        return only_alike(autos, response)


def coherences(functions: Sequence[Function]) -> Coherences:
    """Sort the coherence functions and auto spectra of a file."""
    table = Coherences()
    for function in functions:
        key = place_of(function)
        if function.kind == COHERENCE:
            table.coherence[(*key, *reference_of(function))] = function
            table.coherence.setdefault(key, function)
        elif function.kind in (AUTO, PSD):
            table.auto.setdefault(key, []).append(function)
    return table


def place_of(function: Function) -> Key:
    """Return point, direction without sign, and load case."""
    entity = function.entity if function.node == 0 else ""
    return (function.node, entity, abs(function.direction), function.load_case)


def reference_of(function: Function) -> tuple[int, int]:
    """Return node and direction of the reference where they mean something: single excitation, a response."""
    if function.load_case != 0 or function.kind not in (FRF, TRANSMISSIBILITY, COHERENCE):
        return 0, 0
    return function.reference_node, function.reference_direction


def _check_stated(coherence: Function, response: Function, where: str) -> Array:
    """Return a coherence function unchanged, after checks."""
    if not same_abscissa(coherence, response):
        step = "Export both with the same frequencies, or leave the coherence out"
        raise KinematicsError.of(
            "the coherence", "given at the frequencies of its response", "others", where, step
        )
    value = coherence.y.real
    if np.any(value < -1e-6) or np.any(value > 1.0 + 1e-4):
        got = f"{value.min():g} to {value.max():g}"
        raise KinematicsError.of("the coherence", "within 0 and 1", got, where, "Export it again")
    return np.clip(value, 0.0, 1.0)
