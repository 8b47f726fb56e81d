"""The declaration of an option, and the faults of its values."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from legacy.stapeskit.faults import Fault
from legacy.stapeskit.option_kinds import Kind
from legacy.stapeskit.option_names import suggestion
from legacy.stapeskit.option_values import shorten_value, toml
from legacy.stapeskit.system_faults import MISSING, why_unreadable

DECLARED = "option"
"""Key of a declaration in the metadata of a field."""
_DECIMAL_COMMA = re.compile(r"\d+,\d+")
_THOUSANDS = re.compile(r"[1-9]\d{0,2},\d{3}")


@dataclass(frozen=True)
class Option:
    """One option.

    Attributes
    ----------
    field : str
        Name of the attribute, unit included: ``box_mm``.
    name : str
        Name in Python and, with dashes, on the command line: ``box``.
    table, key : str
        Place in a study file: ``scan``, ``box_mm``. The table is empty for options of commands alone.
    help : str
        What it does, one phrase.
    default : object
        None: not given.
    metavar : str
        Placeholder of its value in the help.
    group : str
        Heading in the help.
    example : object
        A value, as in a study file.
    recommended : bool
        Whether the template of a study file sets it to the example.
    """

    field: str
    name: str
    table: str
    key: str
    kind: Kind
    help: str
    default: Any = None
    metavar: str = ""
    group: str = ""
    example: Any = None
    positional: bool = False
    required: bool = False
    recommended: bool = False

    @property
    def flag(self) -> str:
        """The name on the command line."""
        return self.metavar if self.positional else "--" + self.name.replace("_", "-")

    @property
    def place(self) -> str:
        """The name in a study file."""
        return f"{self.table}.{self.key}"

    def read(self, value: Any, faults: list[Fault], thing: str = "", where: str = "") -> Any:
        """Return a value as its kind reads it; of an unfit one None, and its fault in the list."""
        try:
            return self.kind.read(value)
        except (ValueError, TypeError):
            faults.append(self.fault(value, thing, where))
            return None

    def fault(self, got: Any, thing: str = "", where: str = "") -> Fault:
        """Return the fault of a value that is unfit; ``thing`` is its name where a TOML file holds it."""
        step = self.kind.advise(got) if self.kind.advise else ""
        if not step and isinstance(got, str) and _DECIMAL_COMMA.fullmatch(got):
            step = f"Write a decimal point: {got.replace(',', '.')}"
            if _THOUSANDS.fullmatch(got):
                step = f"Write {got.replace(',', '')}, or a decimal point: {got.replace(',', '.')}"
        wrong = (word for word in shorten_value(got).split(",") if word.strip() not in self.kind.choices)
        step = step or suggestion(next(wrong, ""), self.kind.choices) or self._example_step(bool(thing))
        return Fault(thing or f"{{{self.name}}}", self.kind.expected, shorten_value(got), where, step)

    def _example_step(self, in_toml: bool) -> str:
        """Return the advice to write the value in the way of the example, or of the default."""
        value = self.kind.read(self.default if self.example is None else self.example)
        return f"Write for example {toml(value) if in_toml else self.kind.words(value)[0]}"

    def missing_files(
        self, value: Any, thing: str, where: str = "", folder: Path | None = None
    ) -> list[Fault]:
        """Return a fault for each file of the value that cannot be read, looked for in a folder."""
        if not self.kind.is_file or value is None:
            return []
        faults = []
        for path in value if isinstance(value, tuple) else (value,):
            got = why_unreadable((folder or Path()) / path)
            if got == MISSING:
                faults.append(self.fault(path, thing, where))
            elif got:
                step = "Change its permissions, or copy it to another place"
                faults.append(Fault(thing, "a file that can be read", f"{got}: {path}", where, step))
        return faults


def option(
    kind: Kind,
    text: str,
    default: Any = None,
    *,
    unit: str = "",
    key: str = "",
    metavar: str = "",
    group: str = "",
    example: Any = None,
    positional: bool = False,
    required: bool = False,
    recommended: bool = False,
    command_only: bool = False,
) -> Any:
    """Declare an option, as the default of a field of an `OptionTable`.

    Parameters
    ----------
    text : str
        The help.
    unit : str
        Suffix of its key in a study file, as in ``box_mm``; its name on the command line is without it.
    key : str
        Its key in a study file, where that is neither.
    command_only : bool
        Whether no study file may hold it.
    metavar, group, example, positional, required, recommended
        See `Option`.
    """
    entry = {
        "kind": kind, "help": text, "unit": unit, "key": key, "metavar": metavar or kind.metavar,
        "group": group, "example": example, "positional": positional, "required": required,
        "recommended": recommended, "command_only": command_only,
    }  # fmt: skip
    if isinstance(default, dict):
        return field(default_factory=lambda: dict(default), metadata={DECLARED: entry})
    return field(default=default, metadata={DECLARED: entry})
