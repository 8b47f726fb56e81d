"""Compare two tables of results: missing and added places, changed numbers, words and prose.

Numbers agree within 1e-9 of themselves, or within 1e-12 of their scale: of a symmetric positive matrix the
root of the two diagonal entries, else the largest entry of the same column (last axis) or list, so that what
is an exact zero but for rounding cannot fail. A lone number takes as its scale the largest of the numbers of
its name in the file (all ``[*].chi2``), a contribution to an uncertainty the largest of all contributions to
the same quantity. A standard deviation is the root of such a zero: two that are both below 1e-6 of their
scale agree.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

RTOL = 1e-9
FLOOR = 1e-12
CONTRIBUTION = re.compile(r"((?:uncertainty|budget|contributions\w*)\.)(?:.+\.)?([^.]+)$")
OF_VARIANCES = re.compile(r"contributions\w*\.[^.]+$")
DEVIATION = re.compile(r"(?:uncertainty|budget)\.|_sd(?:_|$)|standard_deviation|^[^:]*:\w*_sd_")


@dataclass(frozen=True)
class Difference:
    """One difference.

    Attributes
    ----------
    kind : str
        missing, added, number, word or message; only added and message do not fail.
    place : str
    old, new : str
    relative : float
    """

    kind: str
    place: str
    old: str = ""
    new: str = ""
    relative: float = float("nan")

    def __str__(self) -> str:
        if self.kind in ("missing", "added"):
            return f"{self.kind} {self.place} {self.old}{self.new}".rstrip()
        size = f" (relative {self.relative:.2g})" if np.isfinite(self.relative) else ""
        return f"{self.kind} {self.place}: {self.old} -> {self.new}{size}"


def differences(
    old: Mapping[str, Any], new: Mapping[str, Any], renamed: Mapping[str, str], rtol: float = RTOL
) -> list[Difference]:
    """Return what differs; ``renamed`` maps patterns of old places to their new names."""
    for pattern, name in renamed.items():
        old = {re.sub(pattern, name, place): value for place, value in old.items()}
    scales = _group_scales(old)
    found = []
    for place, value in old.items():
        if place in new:
            found += _of_value(place, value, new[place], scales.get(_group(place)), rtol)
    missing = [place for place in old if place not in new]
    added = [place for place in new if place not in old]
    for place in missing:
        same = [other for other in added if not _of_value(place, old[place], new[other], None, rtol)]
        hint = f"(renamed to {same[0]}?)" if same else ""
        found.append(Difference("missing", place, hint))
    return found + [Difference("added", place) for place in added]


def _of_value(place: str, old: Any, new: Any, scale: Any, rtol: float) -> list[Difference]:
    if isinstance(old, dict) and isinstance(new, dict) and "n" in old and "n" in new:
        return _of_numbers(place, old, new, scale, rtol)
    if isinstance(old, dict) and "prose" in old:
        told = new.get("prose") if isinstance(new, dict) else new
        if told == old["prose"]:
            return []
        return [Difference("message", place, _short(old["prose"]), _short(told))]
    if old == new:
        return []
    if isinstance(old, list) and isinstance(new, list):
        gone, come = [w for w in old if w not in new], [w for w in new if w not in old]
        if place == "files" and not gone:
            return [Difference("added", f"files {come}")]
        if gone or come:
            return [Difference("word", place, f"{_short(gone)} gone", f"{_short(come)} new")]
    return [Difference("word", place, _short(old), _short(new))]


def _of_numbers(
    place: str, old: Mapping[str, Any], new: Mapping[str, Any], scale: Any, rtol: float
) -> list[Difference]:
    if old["shape"] != new["shape"]:
        return [Difference("number", f"{place} shape", str(old["shape"]), str(new["shape"]))]
    found = []
    if old["n"] != new["n"]:
        a, b = _array(old["n"]), _array(new["n"])
        whole = _scales(a, old)
        if scale is not None and scale.shape == whole.shape:
            whole = np.maximum(whole, scale)
        if DEVIATION.search(place):
            zero = np.sqrt(FLOOR) * whole
            a, b = (np.where(np.maximum(np.abs(a), np.abs(b)) < zero, 0.0, v) for v in (a, b))
        found += _worst(place, a, b, FLOOR * whole, rtol)
    if old.get("missing") != new.get("missing"):
        found.append(
            Difference("number", f"{place} not finite", str(old.get("missing")), str(new.get("missing")))
        )
    if old.get("sums") != new.get("sums") and "sums" in old and "sums" in new:
        a, b = _array(old["sums"]), _array(new["sums"])
        found += _worst(f"{place} sums", a, b, FLOOR * np.nanmax(np.abs(a)), rtol)
    return found


def _worst(place: str, a: np.ndarray, b: np.ndarray, floor: Any, rtol: float) -> list[Difference]:
    """Return the largest difference beyond the tolerance, and how many there are."""
    with np.errstate(invalid="ignore", divide="ignore"):
        gap = np.abs(b - a)
        size = np.maximum(np.abs(a), np.abs(b))
        beyond = ~((gap <= np.maximum(rtol * size, floor)) | (a == b) | (np.isnan(a) & np.isnan(b)))
        relative = np.where(size > 0.0, gap / size, 0.0)
    if not np.any(beyond):
        return []
    at = int(np.argmax(np.where(beyond, np.nan_to_num(relative, nan=np.inf), -1.0)))
    count = f" [{np.sum(beyond)} of {a.size}, worst at {at}]" if a.size > 1 else ""
    return [Difference("number", place + count, f"{a[at]:.12g}", f"{b[at]:.12g}", float(relative[at]))]


def _array(values: list[Any]) -> np.ndarray:
    return np.array([float(v) for v in values])


def _scales(values: np.ndarray, told: Mapping[str, Any]) -> np.ndarray:
    shape = tuple(told["shape"])
    finite = np.where(np.isfinite(values), np.abs(values), 0.0)
    if told["scale"] == "diagonal":
        array = finite.reshape(shape)
        diagonal = np.sqrt(np.einsum("...ii->...i", array))
        return (diagonal[..., :, None] * diagonal[..., None, :]).ravel()
    if told["scale"] == "column":
        array = finite.reshape(shape)
        largest = array.max(axis=tuple(range(array.ndim - 1)), initial=0.0)
        return np.broadcast_to(largest, shape).ravel()
    largest = float(told.get("largest", finite.max(initial=0.0)))
    return np.full(values.shape, largest)


def _group(place: str) -> str:
    """Return what the places of one kind have in common."""
    place = re.sub(r"\[\d+\]", "[*]", place)
    if OF_VARIANCES.search(place):
        return place.rpartition(".")[0]
    return CONTRIBUTION.sub(r"\1*.\2", place)


def _group_scales(table: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the scale of the entries of each group: the largest of its members of the first one's shape."""
    scales: dict[str, np.ndarray] = {}
    for place, value in table.items():
        group = _group(place)
        if not isinstance(value, dict) or "n" not in value or (value["shape"] and group == place):
            continue
        own = _scales(_array(value["n"]), value)
        before = scales.setdefault(group, own)
        if before.shape == own.shape:
            scales[group] = np.maximum(before, own)
    return scales


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) < 160 else text[:157] + "..."
