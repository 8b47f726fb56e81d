"""Options: each is declared once, as a field of its room's option table.

From the declarations come the parser of the command, ``--config``, the tables of a study file and their
template, the help, the parameters of the provenance and ``docs/options.md``.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.option_kinds import Kind
from stapeskit.option_values import command_word, is_with_sd
from stapeskit.system_faults import MISSING, why_unreadable

_DECLARED = "option"
_WRITING = ("out", "force", "no_report", "export", "smooth", "faces", "sha256", "quiet", "json")
_WRITE = "Write files with .write(folder) of the result"
_DECIMAL_COMMA = re.compile(r"\d+,\d+")
Table = TypeVar("Table", bound="OptionTable")


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
    kind : Kind
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
    positional, required : bool
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

    def fault(self, got: Any, thing: str = "", where: str = "") -> Fault:
        """Return the fault of a value that is unfit."""
        step = self.kind.advise(got) if self.kind.advise else ""
        if not step and isinstance(got, str) and _DECIMAL_COMMA.fullmatch(got):
            step = f"Write a decimal point: {got.replace(',', '.')}"
        return Fault(thing or f"{{{self.name}}}", self.kind.expected, shorten_value(got), where, step)

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
    kind : Kind
    text : str
        The help.
    default : object
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
        return field(default_factory=lambda: dict(default), metadata={_DECLARED: entry})
    return field(default=default, metadata={_DECLARED: entry})


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


@dataclass(frozen=True)
class OptionTable:
    """A table of options: its fields are declared by `option`, and checked when it is made.

    Raises
    ------
    StapeskitError
        The room's error: values are unfit, or break a rule; all in one message.
    """

    table: ClassVar[str] = ""
    title: ClassVar[str] = ""
    rules: ClassVar[tuple[Rule, ...]] = ()
    error: ClassVar[type[StapeskitError]] = StapeskitError

    def __post_init__(self) -> None:
        faults = []
        for entry in declared(type(self)):
            value = getattr(self, entry.field)
            if value is None:
                continue
            try:
                object.__setattr__(self, entry.field, entry.kind.read(value))
            except (ValueError, TypeError):
                faults.append(entry.fault(value))
        raise_all(self.error, faults)
        raise_all(self.error, self.contradictions())

    def contradictions(self) -> list[Fault]:
        """Return the faults of the rules that the values break."""
        options = declared(type(self))
        values = Values({entry.field: getattr(self, entry.field) for entry in options}, options)
        return [fault for rule in self.rules if (fault := rule.fault(values)) is not None]

    @classmethod
    def of(cls, **named: Any) -> Self:
        """Make the table from options by the names that they have on the command line."""
        names = {entry.name: entry.field for entry in declared(cls)}
        names |= {entry.field: entry.field for entry in declared(cls)}
        unknown = [name for name in named if name not in names]
        raise_all(
            cls.error,
            [
                Fault(
                    "an option",
                    "a known one",
                    name,
                    "",
                    _WRITE if name in _WRITING else suggestion(name, names),
                )
                for name in unknown
            ],
        )
        return cls(**{names[name]: value for name, value in named.items()})

    def parameters(self) -> dict[str, Any]:
        """Return the values by key, files apart, as JSON-able data: for the provenance."""
        return {
            entry.key: plain(getattr(self, entry.field))
            for entry in declared(type(self))
            if not entry.kind.is_file
        }

    def anchored(self) -> Self:
        """Return the same options with absolute paths of files: they hold when the working folder changes."""
        paths: dict[str, Any] = {}
        for entry in declared(type(self)):
            value = getattr(self, entry.field)
            if entry.kind.is_file and isinstance(value, Path):
                paths[entry.field] = value.absolute()
            elif entry.kind.is_file and isinstance(value, tuple):
                paths[entry.field] = tuple(Path(path).absolute() for path in value)
        return dataclasses.replace(self, **paths)

    def input_files(self) -> dict[str, Path | None]:
        """Return the files that are read, by the name of their option."""
        return {
            entry.name: getattr(self, entry.field)
            for entry in declared(type(self))
            if entry.kind.is_file and not entry.kind.repeats
        }


def declared(table: type[OptionTable]) -> tuple[Option, ...]:
    """Return the options of a table in the order of their entry."""
    return tuple(_declared(table))


def _declared(table: type[OptionTable]) -> Iterator[Option]:
    for entry in dataclasses.fields(table):
        if _DECLARED not in entry.metadata:
            continue
        rest = dict(entry.metadata[_DECLARED])
        unit, key, command_only = (rest.pop(name) for name in ("unit", "key", "command_only"))
        name = entry.name.removesuffix(f"_{unit}") if unit else entry.name
        default = entry.default_factory() if callable(entry.default_factory) else entry.default
        default = None if default is None else rest["kind"].read(default)
        place = "" if command_only else table.table
        yield Option(
            entry.name,
            name,
            place,
            key or (f"{name}_{unit}" if unit else name),
            default=default,
            **rest,
        )


def read_table(
    kind: type[Table],
    values: Mapping[str, Any],
    where: str,
    folder: Path,
    others: Iterable[type[OptionTable]] = (),
    check_files: bool = True,
) -> tuple[Table | None, list[Fault]]:
    """Read a table of a study file.

    Parameters
    ----------
    kind : type
    values : mapping
        The table as TOML gives it.
    where : str
        Name of the file, for messages.
    folder : Path
        Where relative paths start.
    others : iterable of type
        Tables in which the key of an unknown option is looked for, too.
    check_files : bool
        Whether the files named must exist.

    Returns
    -------
    table : OptionTable or None
    faults : list of Fault
        Unknown keys (with the nearest), missing ones, unfit values, files that do not exist, contradictions.
    """
    options = {entry.key: entry for entry in declared(kind) if entry.table}
    faults = [unknown_key(kind, key, where, others) for key in values if key not in options]
    chosen: dict[str, Any] = {}
    for key, entry in options.items():
        if key not in values:
            if entry.required:
                step = "scan2kd --template shows a whole study file"
                faults.append(Fault(entry.place, "given", "nothing", where, step))
            continue
        try:
            value = entry.kind.read(values[key])
        except (ValueError, TypeError):
            faults.append(entry.fault(values[key], entry.place, where))
            continue
        if entry.kind.is_file:
            faults += entry.missing_files(value, entry.place, where, folder) if check_files else []
            value = tuple(folder / path for path in value) if isinstance(value, tuple) else folder / value
        chosen[entry.field] = value
    try:
        return (None if faults else kind(**chosen)), faults
    except StapeskitError as error:
        return None, [*faults, *(dataclasses.replace(fault, where=where) for fault in error.faults)]


def unknown_key(
    kind: type[OptionTable], key: str, where: str, others: Iterable[type[OptionTable]] = ()
) -> Fault:
    """Return the fault of an unknown key, with the nearest of its own table or the same key of another."""
    own = [entry.key for entry in declared(kind) if entry.table]
    homes = [entry.place for other in others for entry in declared(other) if entry.table and entry.key == key]
    close = difflib.get_close_matches(key, own, 1, cutoff=0.5) or homes
    step = f"Did you mean {close[0]}?" if close else f"Its keys are {', '.join(own)}"
    return Fault(f"a key of [{kind.table}]", "a known one", key, where, step)


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return a question for the nearest known word, or nothing."""
    close = difflib.get_close_matches(word, list(known), 1)
    return f"Did you mean {close[0]}?" if close else ""


def shorten_value(value: Any) -> str:
    """Show a value in a message, shortened."""
    if is_with_sd(value):
        text = command_word(value)
    elif isinstance(value, list | tuple):
        text = ",".join(shorten_value(entry) for entry in value if entry is not None)
    else:
        text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def plain(value: Any) -> Any:
    """Return a value as JSON-able data."""
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value
