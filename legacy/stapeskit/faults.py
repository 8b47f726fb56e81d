"""Faults in the user's input, as data; the sentence a person reads is made where it is shown.

A fault reads ``<thing> must be <expected>; got <value> (<file, row>). <what to do next>.``
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Self

from legacy.stapeskit.option_names import Vocabulary, named, use_vocabulary, written

LONGEST = 4000
"""Characters of a message at most: what fits on a screen or two."""

FEW = 5
"""Faults of a kind that are written one by one."""

PARSER_ERRORS = (
    *(ValueError, ArithmeticError, LookupError, TypeError, AttributeError),
    *(RecursionError, EOFError, struct.error),
)
"""What parsers raise on damaged content that no check has met: impossible numbers, nested too deeply, cut."""

_FIELD = 500  # characters of one text of a fault where the whole is too long: five fit into LONGEST - _REST
_REST = 1000  # characters kept for the line that counts the rest


@dataclass(frozen=True)
class Place:
    """Where a fault lies.

    Attributes
    ----------
    file : str
        Name of the file.
    unit : str
        What ``numbers`` count: line, row, dataset, record, ...; empty when the file as a whole is meant.
    numbers : tuple of int
        Lines, rows or datasets at fault, from 1.
    detail : str
        A column, a signal, ...: what lies within the line.
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
    thing : str
        What is wrong.
    expected : str
        What it must be. Empty for a message that is no such sentence: ``thing`` is then the whole of it.
    got : str
        The value; any object is accepted and kept as its text.
    where : str or Place
        File, row or field; may be empty.
    next_step : str
        What the user can do; may be empty.

    Notes
    -----
    ``thing``, ``expected`` and ``next_step`` may refer to an option as ``{name}``; see `render`.
    """

    thing: str
    expected: str = ""
    got: object = ""
    where: str | Place = ""
    next_step: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "got", str(self.got))

    def __str__(self) -> str:
        return render(self)


def translate_fault(fault: Fault, vocabulary: Vocabulary) -> Fault:
    """Return a fault whose references to options are written by a vocabulary."""
    texts = (written(text, vocabulary) for text in (fault.thing, fault.expected, fault.next_step))
    thing, expected, step = texts
    return replace(fault, thing=thing, expected=expected, next_step=step)


def render(fault: Fault, vocabulary: Vocabulary = named) -> str:
    """Write a fault as a sentence.

    Parameters
    ----------
    vocabulary : callable
        Takes the name of an option, returns what the reader calls it; default that of the edge.
    """

    fault = translate_fault(fault, vocabulary)
    if not fault.expected:
        return fault.thing
    place = f" ({fault.where})" if str(fault.where) else ""
    step = fault.next_step.rstrip(".")
    stop = "" if not step or step.endswith("?") else "."
    sentence = f"{fault.thing} must be {fault.expected}; got {fault.got}{place}."
    return f"{sentence} {step}{stop}" if step else sentence


class StapeskitError(ValueError):
    """Base of every error that the user's input can cause; the commands end with exit code 2 on it.

    Parameters
    ----------
    *faults : Fault or str
        A plain string is a fault of which only the message is known.

    Attributes
    ----------
    faults : tuple of Fault
        Every fault, also those that the message only counts.
    """

    def __init__(self, *faults: Fault | str) -> None:
        self.faults: tuple[Fault, ...] = tuple(
            fault if isinstance(fault, Fault) else Fault(fault) for fault in faults
        )
        super().__init__(*self.faults)

    @classmethod
    def of(
        cls, thing: str, expected: str = "", got: object = "", where: str | Place = "", next_step: str = ""
    ) -> Self:
        """Return the error with one fault; for the arguments see `Fault`."""
        return cls(Fault(thing, expected, got, where, next_step))

    def __str__(self) -> str:
        return format_faults(self.faults)


def raise_all(error: type[StapeskitError], faults: Iterable[Fault]) -> None:
    """Raise one error that holds every fault, each once, or return when there is none.

    Raises
    ------
    StapeskitError
        The given class, when there is at least one fault.
    """
    distinct = dict.fromkeys(faults)
    if distinct:
        raise error(*distinct)


@contextmanager
def translate_option_names(vocabulary: Vocabulary) -> Iterator[None]:
    """Write the names of options in texts and errors of the block by a vocabulary."""
    with use_vocabulary(vocabulary):
        try:
            yield
        except StapeskitError as error:
            error.faults = tuple(translate_fault(fault, vocabulary) for fault in error.faults)
            raise


@contextmanager
def collect_faults(faults: list[Fault]) -> Iterator[None]:
    """Add the faults raised inside the block to a list, and go on after the block."""
    try:
        yield
    except StapeskitError as error:
        faults += error.faults


def format_faults(faults: Sequence[Fault], vocabulary: Vocabulary = named) -> str:
    """Write faults one a line, in `LONGEST` characters at most.

    More than `FEW` faults that differ in their row and value only become one sentence with ranges of rows.
    If the message is still too long, faults that differ in their thing too are joined; then some of every
    kind are written, and the rest is counted with its rows.

    Parameters
    ----------
    vocabulary : callable
        As of `render`.
    """
    rows_joined = _join_groups(faults, _same_thing)
    kinds_joined = [_shorten(fault) for fault in _join_groups(rows_joined, _same_kind)]
    for listed in (rows_joined, kinds_joined):
        lines = [render(fault, vocabulary) for fault in listed]
        if sum(map(len, lines)) + len(lines) <= LONGEST:
            return "\n".join(lines)
    room = LONGEST - _REST
    written = []
    for number in _alternate_kinds(listed):
        room -= len(lines[number]) + 1
        if room < 0:
            break
        written.append(number)
    rest = [fault for number, fault in enumerate(listed) if number not in written]
    return "\n".join([*(lines[number] for number in sorted(written)), _count(rest)])


def _same_thing(fault: Fault) -> Hashable:
    """Return what faults share that differ in their row and value only."""
    where = fault.where
    place = replace(where, numbers=()) if isinstance(where, Place) and where.numbers else where
    return fault.thing, fault.expected, fault.next_step, place


def _same_kind(fault: Fault) -> Hashable:
    """Return the fields that are equal in faults with different things, places and values."""
    return fault.expected or fault.thing, fault.next_step


def _join_groups(faults: Sequence[Fault], key: Callable[[Fault], Hashable]) -> list[Fault]:
    """Join each group of more than `FEW` faults into one, at the place of its first."""
    groups: dict[Hashable, list[int]] = {}
    for number, fault in enumerate(faults):
        groups.setdefault(key(fault), []).append(number)
    joined: dict[int, Fault] = {}
    for members in groups.values():
        if len(members) > FEW:
            joined[members[0]] = _join([faults[number] for number in members])
        else:
            joined.update((number, faults[number]) for number in members)
    return [joined[number] for number in sorted(joined)]


def _join(faults: Sequence[Fault]) -> Fault:
    """Return one fault for several of a kind."""
    things = list_some([fault.thing for fault in faults])
    values = list_some([str(fault.got) for fault in faults])
    places = [fault.where for fault in faults]
    rows = [place for place in places if isinstance(place, Place) and place.numbers]
    first = places[0]
    where: Place | str = list_some([str(place) for place in places if str(place)])
    if isinstance(first, Place) and len(rows) == len(places):
        details = {place.detail for place in rows}
        if {(place.file, place.unit) for place in rows} == {(first.file, first.unit)}:
            numbers = tuple(number for place in rows for number in place.numbers)
            where = Place(first.file, first.unit, numbers, first.detail if len(details) == 1 else "")
    return Fault(things, faults[0].expected, values, where, faults[0].next_step)


def list_some(texts: Iterable[str], most: int = 3, between: str = ", ") -> str:
    """List the first distinct texts and count the others."""
    distinct = list(dict.fromkeys(texts))
    more = f" and {len(distinct) - most} more" if len(distinct) > most else ""
    return between.join(distinct[:most]) + more


def _shorten(fault: Fault) -> Fault:
    """Cut long texts of a fault in their middle."""
    where = fault.where if len(str(fault.where)) <= _FIELD else _cut(str(fault.where))
    return Fault(_cut(fault.thing), _cut(fault.expected), _cut(str(fault.got)), where, _cut(fault.next_step))


def _cut(text: str) -> str:
    half = (_FIELD - 5) // 2
    return text if len(text) <= _FIELD else f"{text[:half]} ... {text[-half:]}"


def _alternate_kinds(faults: Sequence[Fault]) -> list[int]:
    """Return the numbers of the faults, every kind in turn."""
    kinds: dict[Hashable, list[int]] = {}
    for number, fault in enumerate(faults):
        kinds.setdefault(fault.expected or fault.thing, []).append(number)
    turns = sorted((turn, number) for members in kinds.values() for turn, number in enumerate(members))
    return [number for _, number in turns]


def _count(faults: Sequence[Fault]) -> str:
    """Count faults and list the rows of the first files."""
    rows: dict[tuple[str, str], list[int]] = {}
    for fault in faults:
        if isinstance(fault.where, Place) and fault.where.numbers:
            rows.setdefault((fault.where.file, fault.where.unit), []).extend(fault.where.numbers)
    parts = [f"{format_ranges(numbers, unit, 5)} of {file}" for (file, unit), numbers in rows.items()]
    more = f" ({_cut(list_some(parts))})" if parts else ""
    return f"... and {len(faults)} more faults{more}."


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
