"""Faults in the user's input, as data; the sentence that a person reads is made where it is shown.

A fault reads ``<thing> must be <expected>; got <value> (<file, row>). <what to do next>.``
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Self

MOST_SENTENCES = 20
"""Sentences of one message: what fits on a screen."""

JOINED_FROM = 6
"""So many faults that differ only in their row, file or thing, and value, become one sentence."""

_LONGEST_TEXT = 500  # letters of one field of a fault: longer ones are cut in their middle


@dataclass(frozen=True)
class Place:
    """Where a fault lies: a file, and in it numbers (from 1) of lines, rows, datasets or other ``unit``.

    ``detail`` is a column, a signal, ...: what lies within the line.
    """

    file: str
    unit: str = ""
    numbers: tuple[int, ...] = ()
    detail: str = ""

    def __str__(self) -> str:
        numbers = format_ranges(self.numbers, self.unit) if self.numbers else ""
        return ", ".join(part for part in (self.file, numbers, self.detail) if part)


@dataclass(frozen=True)
class Fault:
    """One fault in the user's input.

    Attributes
    ----------
    thing, expected : str
        What is wrong (options as on the command line, ``--box``), and what it must be. Without the latter
        ``thing`` is the whole message.
    got : str
        The value; any object is accepted and kept as its text.
    where : str or Place
        File, row or field; may be empty.
    next_step : str
        What the user can do; may be empty.
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
    """Every error that the user's input can cause; the commands end with exit code 2 on it.

    ``faults`` holds every fault, also those that the message only counts. A plain string is a fault of which
    only the message is known.
    """

    def __init__(self, *faults: Fault | str) -> None:
        self.faults = tuple(fault if isinstance(fault, Fault) else Fault(fault) for fault in faults)
        super().__init__(*self.faults)

    @classmethod
    def of(
        cls, thing: str, expected: str = "", got: object = "", where: str | Place = "", next_step: str = ""
    ) -> Self:
        """Return the error with one fault; for the arguments see `Fault`."""
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
    """Join faults that differ in their row, then in their file, then in their thing, and in their value."""
    kinds: tuple[Callable[[Fault], Hashable], ...] = (
        lambda fault: (fault.thing, _without_numbers(fault.where)),
        lambda fault: fault.thing,
        lambda fault: (fault.got, _without_numbers(fault.where)),
    )
    joined = list(faults)
    for kind in kinds:
        groups: dict[Hashable, list[Fault]] = {}
        for fault in joined:
            groups.setdefault((kind(fault), fault.expected, fault.next_step), []).append(fault)
        joined = []
        for group in groups.values():
            joined += [_joined(group)] if len(group) >= JOINED_FROM else group
    return joined


def _without_numbers(where: str | Place) -> str | Place:
    return replace(where, numbers=()) if isinstance(where, Place) else where


def _joined(group: Sequence[Fault]) -> Fault:
    """Return one fault for several, with the first of their things, values and places."""
    thing, got = (list_some(getattr(fault, name) for fault in group) for name in ("thing", "got"))
    places = [fault.where for fault in group if isinstance(fault.where, Place)]
    where: str | Place = list_some(filter(None, (str(fault.where) for fault in group)), between="; ")
    if len(places) == len(group) and len(set(map(_without_numbers, places))) == 1:
        where = replace(places[0], numbers=tuple(number for place in places for number in place.numbers))
    return replace(group[0], thing=thing, got=got, where=where)


def list_some(texts: Iterable[str], most: int = 3, between: str = ", ") -> str:
    """List the first distinct texts and count the others."""
    distinct = list(dict.fromkeys(texts))
    more = f" and {len(distinct) - most} more" if len(distinct) > most else ""
    return between.join(distinct[:most]) + more


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
