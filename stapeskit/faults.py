"""The faults a user can cause, and the one sentence form in which they are told."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

_PLACE = re.compile(r"\(([^()]+?)(?:, dataset \d+)?, (line|dataset|row|channel|record|step) (\d+)")


class StapeskitError(ValueError):
    """Base of every error that the user's input can cause; the commands end with exit code 2 on it.

    Attributes
    ----------
    faults : tuple of str
        Every fault, also those that the message only counts; empty when the message is the one fault.
    """

    faults: tuple[str, ...] = ()


def sentence(thing: str, expected: str, got: object, where: str = "", next_step: str = "") -> str:
    """Write one fault as ``<thing> must be <expected>; got <value> (where). <next step>.``

    Parameters
    ----------
    thing, expected : str
        What is wrong and what it must be.
    got : object
        The value found; shown as given.
    where : str
        File, row or field; left out when empty.
    next_step : str
        What the user can do; left out when empty.
    """
    place = f" ({where})" if where else ""
    stop = "" if next_step.endswith("?") else "."
    step = f" {next_step.rstrip('.')}{stop}" if next_step else ""
    return f"{thing} must be {expected}; got {got}{place}.{step}"


def raise_all(error: type[StapeskitError], faults: Iterable[str], most: int = 40) -> None:
    """Raise one error that lists every fault of a file, or return when there is none.

    Parameters
    ----------
    error : type
        The room's exception class.
    faults : iterable of str
        Finished sentences.
    most : int
        How many are written out, every kind of fault in turn; of the rest the lines are named.

    Raises
    ------
    StapeskitError
        The given class, with one fault a line, when there is at least one fault.
    """
    listed = list(faults)
    if not listed:
        return
    made = error(_message(listed, most))
    made.faults = tuple(listed)
    raise made


def faults_of(error: StapeskitError) -> list[str]:
    """Return every fault of an error, one sentence each."""
    return list(error.faults) if error.faults else str(error).splitlines()


@contextmanager
def collecting(faults: list[str]) -> Iterator[None]:
    """Add the faults of what goes wrong inside to a list, and go on behind the block."""
    try:
        yield
    except StapeskitError as error:
        faults += faults_of(error)


def _message(listed: list[str], most: int) -> str:
    """Write faults below each other, of long lists some of every kind and a count of the rest."""
    if len(listed) <= most:
        return "\n".join(listed)
    kinds: dict[str, list[int]] = {}
    for number, fault in enumerate(listed):
        kinds.setdefault(_kind(fault), []).append(number)
    turn = sorted((rank, number) for members in kinds.values() for rank, number in enumerate(members))
    shown = sorted(number for _, number in turn[:most])
    rest = [listed[number] for _, number in turn[most:]]
    return "\n".join([*(listed[number] for number in shown), _counted(rest)])


def _kind(fault: str) -> str:
    """Return what a fault is about, without names and values."""
    thing, _, expected = fault.partition("; got ")[0].partition(" must be ")
    return expected or thing


def _counted(faults: list[str]) -> str:
    """Count faults and name the lines they stand in."""
    places: dict[tuple[str, str, str], list[int]] = {}
    for fault in faults:
        found = _PLACE.search(fault)
        if found:
            thing = fault.partition(" must be ")[0]
            thing = thing if len(thing) < 40 else "rows"
            places.setdefault((thing, found[1], found[2]), []).append(int(found[3]))
    parts = [
        f"{thing} in {_ranges(numbers, unit)} of {file}"
        for (thing, file, unit), numbers in sorted(places.items(), key=lambda item: -len(item[1]))[:8]
    ]
    return f"... and {len(faults)} more faults" + (f": {'; '.join(parts)}." if parts else ".")


def _ranges(lines: list[int], unit: str = "line", most: int = 30) -> str:
    """Write numbers of lines (or data sets, rows, ...), neighbours as ranges."""
    ranges: list[list[int]] = []
    for line in sorted(set(lines)):
        if ranges and line == ranges[-1][1] + 1:
            ranges[-1][1] = line
        else:
            ranges.append([line, line])
    words = [f"{first}" if first == last else f"{first} to {last}" for first, last in ranges[:most]]
    more = f" and {len(ranges) - most} more places" if len(ranges) > most else ""
    return f"{unit}{'s' if len(set(lines)) > 1 else ''} {', '.join(words)}{more}"
