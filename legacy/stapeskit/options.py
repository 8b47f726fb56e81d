"""Options: each is declared once, as a field of its room's option table.

From the declarations come the parser of the command, ``--config``, the tables of a study file and their
template, the help, the parameters of the provenance and ``docs/options.md``.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from legacy.stapeskit.faults import Fault, StapeskitError, raise_all
from legacy.stapeskit.option_declaration import DECLARED, Option
from legacy.stapeskit.option_names import suggestion
from legacy.stapeskit.option_rules import Rule, Values

_WRITING = ("out", "force", "no_report", "export", "smooth", "faces", "sha256", "quiet", "json")
_WRITE = "Write files with .write(folder) of the result"
Table = TypeVar("Table", bound="OptionTable")


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
        faults: list[Fault] = []
        for entry in declared(type(self)):
            value = getattr(self, entry.field)
            if value is not None:
                object.__setattr__(self, entry.field, entry.read(value, faults))
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
        steps = {name: suggestion(name, names) for name in named if name not in names}
        steps |= {name: _WRITE for name in steps if name in _WRITING}
        unknown = [Fault("an option", "a known one", name, "", step) for name, step in steps.items()]
        raise_all(cls.error, unknown)
        return cls(**{names[name]: value for name, value in named.items()})

    def parameters(self) -> dict[str, Any]:
        """Return the values by key, without files, as JSON-able data for the provenance."""
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
    return tuple(_iterate_options(table))


def _iterate_options(table: type[OptionTable]) -> Iterator[Option]:
    for entry in dataclasses.fields(table):
        if DECLARED not in entry.metadata:
            continue
        rest = dict(entry.metadata[DECLARED])
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
        value = entry.read(values[key], faults, entry.place, where)
        if value is not None and entry.kind.is_file:
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


def plain(value: Any) -> Any:
    """Return a value as JSON-able data."""
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value
