"""Faults in the user's input, as data; the sentence a person reads is made where it is shown.

A fault reads ``<thing> must be <expected>; got <value> (<file, row>). <what to do next>.``
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

Vocabulary = Callable[[str], str]
"""How the reader of a message writes the option of that name: ``box`` as `--box`, `scan.box_mm`."""

_REFERENCE = re.compile(r"\{([a-z][a-z0-9_]*)\}")


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
        numbers = ranges(self.numbers, self.unit) if self.numbers else ""
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


def as_command(name: str) -> str:
    """Write the name of an option as on the command line."""
    return "--" + name.replace("_", "-")


def render(fault: Fault, vocabulary: Vocabulary = as_command) -> str:
    """Write a fault as a sentence.

    Parameters
    ----------
    fault : Fault
    vocabulary : callable
        Takes the name of an option, returns what the reader calls it.
    """

    def words(text: str) -> str:
        return _REFERENCE.sub(lambda match: vocabulary(match[1]), text)

    if not fault.expected:
        return words(fault.thing)
    place = f" ({fault.where})" if str(fault.where) else ""
    step = words(fault.next_step.rstrip("."))
    stop = "" if not step or step.endswith("?") else "."
    sentence = f"{words(fault.thing)} must be {words(fault.expected)}; got {fault.got}{place}."
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

    def __str__(self) -> str:
        return message(self.faults)


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
def collecting(faults: list[Fault]) -> Iterator[None]:
    """Add the faults raised inside the block to a list, and go on after the block."""
    try:
        yield
    except StapeskitError as error:
        faults += error.faults


def message(faults: Sequence[Fault], vocabulary: Vocabulary = as_command, most: int = 40) -> str:
    """Write faults one a line; of long lists some of every kind, and a count of the rest.

    Parameters
    ----------
    faults : sequence of Fault
    vocabulary : callable
        As of `render`.
    most : int
        How many are written out.
    """
    if len(faults) <= most:
        return "\n".join(render(fault, vocabulary) for fault in faults)
    kinds: dict[str, list[int]] = {}
    for number, fault in enumerate(faults):
        kinds.setdefault(fault.expected or fault.thing, []).append(number)
    turn = sorted((rank, number) for members in kinds.values() for rank, number in enumerate(members))
    shown = sorted(number for _, number in turn[:most])
    rest = [faults[number] for _, number in turn[most:]]
    return "\n".join([*(render(faults[number], vocabulary) for number in shown), _count(rest)])


def _count(faults: Sequence[Fault]) -> str:
    """Count faults and list the lines they are in."""
    places: dict[tuple[str, Place], list[int]] = {}
    for fault in faults:
        if isinstance(fault.where, Place) and fault.where.numbers:
            thing = fault.thing if len(fault.thing) < 40 else "rows"
            whole = replace(fault.where, numbers=(), detail="")
            places.setdefault((thing, whole), []).extend(fault.where.numbers)
    parts = [
        f"{thing} in {ranges(numbers, place.unit)} of {place.file}"
        for (thing, place), numbers in sorted(places.items(), key=lambda item: -len(item[1]))[:8]
    ]
    return f"... and {len(faults)} more faults" + (f": {'; '.join(parts)}." if parts else ".")


def ranges(numbers: Sequence[int], unit: str = "line", most: int = 30) -> str:
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
