"""Contradictions between options, declared once for commands, studies and Python."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from legacy.stapeskit.faults import Fault
from legacy.stapeskit.option_declaration import Option
from legacy.stapeskit.option_values import shorten_value


class Values:
    """Values of options by field or name, for the rules; what is not declared has the value None."""

    def __init__(self, values: Mapping[str, Any], options: Iterable[Option]) -> None:
        self._values = values
        self._options = {name: entry for entry in options for name in (entry.field, entry.name)}

    def __getattr__(self, name: str) -> Any:
        entry = self._options.get(name)
        return None if entry is None else self._values.get(entry.field)

    def has(self, name: str) -> bool:
        """Return whether an option has another value than its default."""
        entry = self._options.get(name)
        return entry is not None and self._values.get(entry.field) != entry.default

    def given(self, *names: str) -> list[Option]:
        """Return those of the options that have another value than their default."""
        return [self._options[name] for name in names if self.has(name)]

    def missing(self, *names: str) -> list[Option]:
        """Return those of the options that have their default."""
        return [self._options[name] for name in names if not self.has(name)]


@dataclass(frozen=True)
class Rule:
    """A contradiction between options.

    Attributes
    ----------
    breaks : callable
        Takes the values, returns whether they break the rule.
    thing, expected, got, next_step : str
        The fault; options are referred to as ``{name}``.
    shows : str
        Field whose value is ``got``.
    """

    breaks: Callable[[Values], object]
    thing: str
    expected: str
    got: str = ""
    next_step: str = ""
    shows: str = ""

    def fault(self, values: Values) -> Fault | None:
        """Return the fault when the values break the rule."""
        if not self.breaks(values):
            return None
        got = shorten_value(getattr(values, self.shows)) if self.shows else self.got
        return Fault(self.thing, self.expected, got, "", self.next_step)


def excludes(name: str, other: str, why: str = "", next_step: str = "Leave one of the two out") -> Rule:
    """Return the rule that an option excludes another one."""
    expected = f"left out when {{{other}}} is given" + (f", {why}" if why else "")
    return Rule(
        lambda v: v.has(name) and v.has(other), f"{{{name}}}", expected, next_step=next_step, shows=name
    )


def needs(name: str, other: str, why: str = "") -> Rule:
    """Return the rule that an option is given with another only."""
    expected = f"given with {{{other}}}" + (f", {why}" if why else "")
    return Rule(
        lambda v: v.has(name) and not v.has(other), f"{{{name}}}", expected, "it alone", f"Add {{{other}}}"
    )
