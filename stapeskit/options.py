"""Options of the commands, declared once: command line, --config, study files, Python, help, template, page.

A table of options is a frozen dataclass made of its annotations. A field's name is its key in a study file
(``box_mm``); `Opt.name`, by default the key without its unit, is the flag and the keyword in Python
(``--box``, ``box=``). All faults of what a user gives come together.

    class ScanOptions(Options):
        table = "scan"
        file: Annotated[ReadFile | None, Opt("volume, folder of slices or mesh", positional=True)] = None
        box_mm: Annotated[Box | None, Opt("part to look at, scan mm", "find", [0, 0, 0, 8, 8, 6])] = None
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from functools import cache
from pathlib import Path
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    Self,
    TypeVar,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.option_types import Kind, WithSd, one_of

_UNIT = re.compile(r"_(mm|um|hz|kg_m3|percent|deg|us|db)$")
_LONGEST_FILE = 10_000_000  # bytes of a TOML file: a thousand times the longest study
_FUNCTION = TypeVar("_FUNCTION", bound=Callable[..., Any])


@dataclass(frozen=True)
class Opt:
    """How people meet an option.

    Attributes
    ----------
    help : str
        What it does, one phrase.
    group : str
        Heading in the help.
    example : object
        A value, as in a study file.
    name : str
        Flag and keyword, where they are not the key without its unit.
    positional, repeats : bool
        Whether it has no flag on the command line; whether it may be given several times.
    recommended : bool
        Whether the template of a study sets it to the example.
    """

    help: str
    group: str = ""
    example: Any = None
    name: str = ""
    positional: bool = False
    repeats: bool = False
    recommended: bool = False


@dataclass(frozen=True)
class Rule:
    """A contradiction between options of a table.

    Attributes
    ----------
    breaks : callable
        Takes the table, returns whether it breaks the rule.
    fault : Fault or callable
        What is said then; a callable takes the table.
    """

    breaks: Callable[[Any], object]
    fault: Fault | Callable[[Any], Fault]


@dataclass(frozen=True)
class Entry:
    """An option of a table: key in a study, name elsewhere, `Opt`, `Kind`, type, default."""

    key: str
    name: str
    opt: Opt
    kind: Kind
    annotation: Any
    default: Any

    @property
    def flag(self) -> str:
        """The name on the command line."""
        return self.name.upper() if self.opt.positional else "--" + self.name.replace("_", "-")

    @property
    def is_flag(self) -> bool:
        """Whether it takes no value on the command line."""
        return self.annotation is bool

    @property
    def example(self) -> Any:
        """A value, as in a study file."""
        return self.default if self.opt.example is None else self.opt.example

    def fault(self, got: Any, called: str, where: str = "") -> Fault:
        """Return the fault of an unfit value."""
        text = str(got[0] if isinstance(got, list) and len(got) == 1 else got)
        step = self.kind.step
        if re.fullmatch(r"\d+,\d+", text) and self.kind.fits(text.replace(",", ".")):
            step = f"Write a decimal point: {text.replace(',', '.')}"
        if not step and self.example is not None:
            shown = on_command_line(self.example) if called.startswith("--") else toml(self.example)
            step = f"Write for example {shown}"
        return Fault(called, self.kind.expected, text, where, step)


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Options:
    """A table of options; ``table`` names it in a study file. Make one by `of`, which checks the values."""

    table: ClassVar[str] = ""
    rules: ClassVar[tuple[Rule, ...]] = ()

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    @classmethod
    def entries(cls) -> tuple[Entry, ...]:
        """Return every option of the table."""
        return _entries(cls)  # type: ignore[arg-type]

    @classmethod
    def key_names(cls) -> tuple[str, ...]:
        """Return the keys of the table in a study file."""
        return tuple(entry.key for entry in cls.entries())

    @classmethod
    def of(cls, **keywords: Any) -> Self:
        """Make the table from keywords by name (``box=``); keys (``box_mm=``) are taken, too.

        Raises
        ------
        StapeskitError
            Every fault of names and values, and every contradiction.
        """
        keys = {entry.name: entry.key for entry in cls.entries()}
        values = {keys.get(name, name): value for name, value in keywords.items() if value is not None}
        return cls.read(values, "", {entry.key: entry.name for entry in cls.entries()})

    @classmethod
    def read(
        cls, values: Mapping[str, Any], where: str, called: Mapping[str, str], folder: Path | None = None
    ) -> Self:
        """Check values by key.

        Parameters
        ----------
        values : mapping
            Values by key.
        where : str
            File that holds them, for messages.
        called : mapping of str to str
            What the reader of the messages calls each key.
        folder : Path, optional
            Folder that relative paths start from.

        Raises
        ------
        StapeskitError
            Every fault of them; contradictions where each value by itself is right.
        """
        known = {entry.key: entry for entry in cls.entries()}
        faults = [unknown(key, list(called.values()), where) for key in values if key not in known]
        found: dict[str, Any] = {}
        for key, entry in known.items():
            if key in values:
                value = (
                    values[key] if folder is None or not entry.kind.is_path else under(folder, values[key])
                )
                if entry.kind.fits(value):
                    found[key] = entry.kind.read(value)
                else:
                    faults.append(entry.fault(values[key], called[key], where))
            elif entry.default is MISSING:
                faults.append(Fault(called[key], "given", "nothing", where))
        raise_all(faults)
        made = cls(**found)
        broken = [rule.fault for rule in cls.rules if rule.breaks(made)]
        raise_all(fault if isinstance(fault, Fault) else fault(made) for fault in broken)
        return made

    @classmethod
    def from_study(cls, values: Mapping[str, Any], file: str, folder: Path) -> Self:
        """Make the table from its part of a study file; relative paths are relative to its folder.

        Raises
        ------
        StapeskitError
            As `read`.
        """
        called = {key: f"{cls.table}.{key}" for key in cls.key_names()}
        return cls.read(values, file, called, folder)

    def given(self) -> dict[str, Any]:
        """Return what differs from its default, by key, as JSON has it: for the provenance of a result."""
        values = ((entry, getattr(self, entry.key)) for entry in self.entries())
        return {entry.key: plain(value) for entry, value in values if value != entry.default}


@cache
def _entries(table: type[Options]) -> tuple[Entry, ...]:
    hints = get_type_hints(table, include_extras=True)
    found = []
    for field in dataclasses.fields(table):  # type: ignore[arg-type]
        opt = get_args(hints[field.name])[-1]
        kind, bare = _kind_and_type(hints[field.name])
        name = opt.name or _UNIT.sub("", field.name)
        found.append(Entry(field.name, name, opt, kind, bare, field.default))
    return tuple(found)


def _kind_and_type(hint: Any) -> tuple[Kind, Any]:
    """Return the kind of a type, and the type without its words: ``Annotated[float, ...] | None``."""
    if get_origin(hint) is Annotated:
        inner, *words = get_args(hint)
        kind = next((word for word in words if isinstance(word, Kind)), None)
        return (kind, inner) if kind is not None else _kind_and_type(inner)
    if get_origin(hint) is Literal:
        return one_of(get_args(hint)), hint
    parts = [part for part in get_args(hint) if part is not type(None)]
    if not parts:
        raise TypeError(f"the type {hint} has no words")
    kind, bare = _kind_and_type(parts[0])
    return kind, bare | None if type(None) in get_args(hint) else bare


def under(folder: Path, value: Any) -> Any:
    """Return a path, or each of several, below a folder unless it is absolute; other values as they are."""
    if isinstance(value, list | tuple):
        return [under(folder, part) for part in value]
    return folder / Path(value).expanduser() if isinstance(value, str | Path) and str(value) else value


def unknown(name: str, known: Sequence[str], where: str = "") -> Fault:
    """Return the fault of a name that no option has, with the nearest one."""
    by_word = {word.rpartition(".")[2].lstrip("-").replace("_", "-"): word for word in known}
    near = difflib.get_close_matches(name.lstrip("-").replace("_", "-"), by_word, 1)
    step = f"Did you mean {by_word[near[0]]}?" if near else ""
    return Fault(name, "a known option", "an unknown one", where, step)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises
    ------
    StapeskitError
        There is no such file, or it is no TOML in UTF-8, with the line where it fails.
    """
    import tomllib

    if not path.is_file():
        raise StapeskitError.of("the TOML file", "an existing file", path, "", "Check its name and folder")
    try:
        data = path.read_bytes()
        if len(data) > _LONGEST_FILE:
            raise ValueError(f"{len(data)} bytes")
        return tomllib.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # TOMLDecodeError and UnicodeDecodeError are ValueErrors
        raise StapeskitError.of("the file", "TOML in UTF-8", error, path.name) from None


def with_options(*tables: type[Options]) -> Callable[[_FUNCTION], _FUNCTION]:
    """Show the options of tables in signature and docstring of a function that takes ``**options``."""

    def decorate(function: _FUNCTION) -> _FUNCTION:
        own = inspect.signature(function)
        kept = [p for p in own.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
        every = (entry for table in tables for entry in table.entries())
        listed = [entry for entry in every if entry.name not in own.parameters and not entry.opt.positional]
        keyword = inspect.Parameter.KEYWORD_ONLY
        added = [
            inspect.Parameter(entry.name, keyword, default=entry.default, annotation=entry.annotation)
            for entry in listed
        ]
        function.__signature__ = own.replace(parameters=[*kept, *added])  # type: ignore[attr-defined]
        lines = [f"{entry.name} : {entry.kind.expected}\n    {entry.opt.help}" for entry in listed]
        text = inspect.cleandoc(function.__doc__ or "")
        function.__doc__ = "\n".join([text, "", "Options", "-------", *lines])
        return function

    return decorate


def plain(value: Any) -> Any:
    """Return a value of an option as JSON has it."""
    if isinstance(value, WithSd | Path):
        return str(value)
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return value


def toml(value: Any) -> str:
    """Write a value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{name} = {toml(entry)}' for name, entry in value.items())} }}"
    return json.dumps(str(value), ensure_ascii=False)


def on_command_line(value: Any) -> str:
    """Write a value as on the command line; of several rows the first."""
    if isinstance(value, list | tuple):
        first = value[0] if value and isinstance(value[0], list | tuple) else value
        return ",".join(map(on_command_line, first))
    return str(value)


def template(title: str, tables: Sequence[type[Options]]) -> str:
    """Return a study file with every key, its help and an example; only recommended keys are set."""
    lines = [f"# {title}"]
    for table in tables:
        lines += ["", f"[{table.table}]"]
        for entry in table.entries():
            mark = "" if entry.opt.recommended else "# "
            lines += [f"# {entry.opt.help}", f"{mark}{entry.key} = {toml(entry.example)}"]
    return "\n".join(lines) + "\n"


def markdown_table(tables: Sequence[type[Options]], flags: bool = True, without: Sequence[str] = ()) -> str:
    """Return options as a Markdown table: name, and meaning with the default.

    With ``flags`` the name is that of the command line, with the key of a study file where that differs;
    without, it is the key. Those named in ``without`` are left out.
    """
    lines = ["| option | what it does |", "|-|-|"]
    for table in tables:
        for entry in (entry for entry in table.entries() if entry.name not in without):
            metavar = "" if entry.is_flag or entry.opt.positional else f" {entry.kind.metavar}"
            name = f"`{entry.flag if flags else entry.key}{metavar}`"
            if flags and table.table and entry.key != entry.name:
                name += f", `{entry.key}`"
            unset = entry.default in (None, False, (), "")
            default = "" if unset else f" (`{on_command_line(plain(entry.default))}`)"
            cells = (name, entry.opt.help + default)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
