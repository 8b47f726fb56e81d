"""Faults in the user's input, as data; the sentence that a person reads is made where it is shown.

A fault reads ``<thing> must be <expected>; got <value> (<file, row>). <what to do next>.``
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Self

MOST_SENTENCES = 20  # of one message: what fits on a screen
JOINED_FROM = 6  # so many faults that differ in their row, and value, alone become one sentence
_LONGEST_TEXT = 500  # letters of one field of a fault: longer ones are cut in their middle


@dataclass(frozen=True)
class Place:
    """Where a fault lies: a file, numbers (from 1) of lines or another ``unit``, a column or other detail."""

    file: str
    unit: str = ""
    numbers: tuple[int, ...] = ()
    detail: str = ""

    def __str__(self) -> str:
        numbers = format_ranges(self.numbers, self.unit) if self.numbers else ""
        return ", ".join(part for part in (self.file, numbers, self.detail) if part)


@dataclass(frozen=True)
class Fault:
    """One fault in the user's input; an option is a thing as on the command line, ``--box``.

    Without ``expected`` the ``thing`` is the whole message; ``got`` is kept as its text; place and next step
    may be empty.
    """

    thing: str
    expected: str = ""
    got: object = ""
    where: str | Place = ""
    next_step: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "got", str(self.got))

    def __str__(self) -> str:
        if not self.expected:
            return _cut(self.thing)
        place = f" ({_cut(str(self.where))})" if str(self.where) else ""
        step = f" {self.next_step.rstrip('.')}" if self.next_step else ""
        stop = "" if step.endswith("?") or not step else "."
        got = _cut(str(self.got))
        return f"{_cut(self.thing)} must be {_cut(self.expected)}; got {got}{place}.{step}{stop}"


class StapeskitError(ValueError):
    """Every error that the user's input can cause; ``faults`` also holds those that it only counts."""

    def __init__(self, *faults: Fault | str) -> None:
        self.faults = tuple(fault if isinstance(fault, Fault) else Fault(fault) for fault in faults)
        super().__init__(*self.faults)

    @classmethod
    def of(
        cls, thing: str, expected: str = "", got: object = "", where: str | Place = "", next_step: str = ""
    ) -> Self:
        """Return the error with one fault."""
        return cls(Fault(thing, expected, got, where, next_step))

    def __str__(self) -> str:
        return format_faults(self.faults)


def raise_all(faults: Iterable[Fault]) -> None:
    """Raise one StapeskitError that holds every fault, each once, or return when there is none."""
    distinct = dict.fromkeys(faults)
    if distinct:
        raise StapeskitError(*distinct)


@contextmanager
def collect_faults(faults: list[Fault]) -> Iterator[None]:
    """Add the faults raised inside the block to a list, and go on after the block."""
    try:
        yield
    except StapeskitError as error:
        faults += error.faults


def format_faults(faults: Sequence[Fault]) -> str:
    """Write faults one a line, rows of one kind joined: `MOST_SENTENCES` at most, and a count of the rest."""
    joined = _join_alike(faults)
    lines = [str(fault) for fault in joined[:MOST_SENTENCES]]
    if len(joined) > MOST_SENTENCES:
        lines.append(f"... and {len(joined) - MOST_SENTENCES} more faults.")
    return "\n".join(lines)


def _join_alike(faults: Sequence[Fault]) -> list[Fault]:
    """Join the faults that differ in their row, and value, alone."""
    groups: dict[Hashable, list[Fault]] = {}
    for fault in faults:
        where = replace(fault.where, numbers=()) if isinstance(fault.where, Place) else fault.where
        groups.setdefault((fault.thing, fault.expected, fault.next_step, where), []).append(fault)
    joined = []
    for group in groups.values():
        places = [fault.where for fault in group if isinstance(fault.where, Place)]
        if len(group) < JOINED_FROM:
            joined += group
            continue
        rows = tuple(number for place in places for number in place.numbers)
        where = replace(places[0], numbers=rows) if places else group[0].where
        joined.append(replace(group[0], got=list_some(str(fault.got) for fault in group), where=where))
    return joined


def list_some(texts: Iterable[str], most: int = 3) -> str:
    """List the first distinct texts and count the others."""
    distinct = list(dict.fromkeys(texts))
    more = f" and {len(distinct) - most} more" if len(distinct) > most else ""
    return ", ".join(distinct[:most]) + more


def _cut(text: str) -> str:
    half = (_LONGEST_TEXT - 5) // 2
    return text if len(text) <= _LONGEST_TEXT else f"{text[:half]} ... {text[-half:]}"


def format_ranges(numbers: Sequence[int], unit: str = "line", most: int = 30) -> str:
    """Write numbers of lines (or rows, datasets, ...), neighbours as ranges: ``lines 3 to 5, 9``."""
    spans: list[list[int]] = []
    for number in sorted(set(numbers)):
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    words = [f"{first}" if first == last else f"{first} to {last}" for first, last in spans[:most]]
    more = f" and {len(spans) - most} more places" if len(spans) > most else ""
    return f"{unit}{'s' if len(set(numbers)) > 1 else ''} {', '.join(words)}{more}"
