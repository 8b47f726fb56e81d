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

import difflib
import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields, replace
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

from stapeskit.documents import read_toml as read_toml
from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.option_types import Kind, WithSd, number, one_of

_UNIT = re.compile(r"_(mm|um|hz|kg_m3|percent|deg|us|db)$")
_FUNCTION = TypeVar("_FUNCTION", bound=Callable[..., Any])
_ANY = Kind(number, "")


@dataclass(frozen=True)
class Opt:
    """An option: how people meet it, as declared; the last four fields are added by its table."""

    help: str  # what it does, one phrase
    group: str = ""  # heading in the help
    example: Any = None  # a value, as in a study file; else the default
    name: str = ""  # flag and keyword; else the key without its unit
    positional: bool = False  # without a flag
    repeats: bool = False  # may be given several times
    recommended: bool = False  # the template of a study sets it to the example
    key: str = ""
    kind: Kind = _ANY
    annotation: Any = None
    default: Any = None

    @property
    def flag(self) -> str:
        """The name on the command line."""
        return self.name.upper() if self.positional else "--" + self.name.replace("_", "-")

    @property
    def is_flag(self) -> bool:
        """Whether it takes no value on the command line."""
        return self.annotation is bool

    @property
    def meaning(self) -> str:
        """The help with the default."""
        unset = self.default in (None, False, (), "")
        return self.help if unset else f"{self.help}; default {on_command_line(_plain(self.default))}"

    def fault(self, got: Any, called: str, where: str = "") -> Fault:
        """Return the fault of an unfit value."""
        if isinstance(got, list) and not (where and self.kind.is_path):  # of several, those that are unfit
            got = [one for one in got if not self.kind.fits(one)] or got
        text = str(got[0] if isinstance(got, list) and len(got) == 1 else got)
        step = self.kind.step
        if re.fullmatch(r"\d+,\d+", text) and self.kind.fits(text.replace(",", ".")):
            step = f"Write a decimal point: {text.replace(',', '.')}"
        if not step and self.example is not None:
            between = "-" if self.kind.metavar == "F1-F2" else ","
            shown = on_command_line(self.example, between) if called.startswith("--") else toml(self.example)
            step = f"Write for example {shown}"
        return Fault(called, self.kind.expected, text.strip() or "nothing", where, step)


@dataclass(frozen=True)
class Rule:
    """A contradiction: whether a table breaks the rule, and the fault, which may depend on the table."""

    breaks: Callable[[Any], object]
    fault: Fault | Callable[[Any], Fault]


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Options:
    """A table of options; ``table`` names it in a study file. Make one by `of`, which checks the values."""

    table: ClassVar[str] = ""
    rules: ClassVar[tuple[Rule, ...]] = ()

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    @classmethod
    def entries(cls) -> tuple[Opt, ...]:
        """Return every option of the table."""
        return _entries(cls)  # type: ignore[arg-type]

    @classmethod
    def of(cls, **keywords: Any) -> Self:
        """Make the table from keywords by name (``box=``); keys (``box_mm=``) are taken, too: see `read`."""
        keys = {entry.name: entry.key for entry in cls.entries()}
        values = {keys.get(name, name): value for name, value in keywords.items() if value is not None}
        return cls.read(values, "", {key: name for name, key in keys.items()})

    @classmethod
    def from_study(cls, values: Mapping[str, Any], file: str, folder: Path) -> Self:
        """Make the table from its part of a study file; paths are relative to its folder: see `read`."""
        return cls.read(values, file, cls.key_names(), folder)

    @classmethod
    def key_names(cls) -> dict[str, str]:
        """Return the keys of the table in a study file, each with its table: ``box_mm``, ``scan.box_mm``."""
        return {entry.key: f"{cls.table}.{entry.key}" for entry in cls.entries()}

    @classmethod
    def read(
        cls, values: Mapping[str, Any], where: str, called: Mapping[str, str], folder: Path | None = None
    ) -> Self:
        """Check values by key, from the file ``where``; paths start at ``folder``.

        Its messages call each key as ``called`` says.

        Raises
        ------
        StapeskitError
            Every fault of them; contradictions where each value by itself is right.
        """
        faults = [unknown(key, list(called.values()), where) for key in values if key not in called]
        found: dict[str, Any] = {}
        for entry in cls.entries():
            key = entry.key
            if key in values:
                value = values[key] if folder is None else under(folder, entry, values[key])
                if entry.kind.fits(value):
                    found[key] = entry.kind.read(value)
                else:
                    faults.append(entry.fault(values[key], called[key], where))
            elif entry.default is MISSING:
                faults.append(Fault(called[key], "given", "nothing", where))
        raise_all(faults)
        made = cls(**found)
        broken = [rule.fault for rule in cls.rules if rule.breaks(made)]
        faults = [fault if isinstance(fault, Fault) else fault(made) for fault in broken]
        raise_all(cls._as_called(fault, called, where) if where else fault for fault in faults)
        return made

    @classmethod
    def _as_called(cls, fault: Fault, called: Mapping[str, str], where: str = "") -> Fault:
        """Return a fault that names flags with the names that the reader of a file knows."""
        names = {entry.flag: called[entry.key] for entry in cls.entries()}
        texts = {
            part: re.sub(r"--[a-z-]+", lambda flag: names.get(flag[0], flag[0]), getattr(fault, part))
            for part in ("thing", "expected", "next_step")
        }
        thing = names.get(texts["thing"], texts["thing"])
        return replace(fault, **(texts | {"thing": thing}), where=fault.where if str(fault.where) else where)

    @classmethod
    @contextmanager
    def as_keys(cls) -> Iterator[None]:
        """Let faults that are raised inside the block name keys of a study in place of flags."""
        try:
            yield
        except StapeskitError as error:
            raise StapeskitError(
                *(cls._as_called(fault, cls.key_names()) for fault in error.faults)
            ) from error

    def given(self) -> dict[str, Any]:
        """Return what differs from its default, by key, as JSON has it: for the provenance of a result."""
        values = ((entry, getattr(self, entry.key)) for entry in self.entries())
        return {entry.key: _plain(value) for entry, value in values if value != entry.default}


@cache
def _entries(table: type[Options]) -> tuple[Opt, ...]:
    hints, found = get_type_hints(table, include_extras=True), []
    for one in fields(table):  # type: ignore[arg-type]
        opt: Opt = get_args(hints[one.name])[-1]
        kind, bare = _kind_and_type(hints[one.name])
        name = opt.name or _UNIT.sub("", one.name)
        example = one.default if opt.example is None else opt.example
        own = {"name": name, "example": example, "key": one.name, "kind": kind, "annotation": bare}
        found.append(replace(opt, default=one.default, **own))
    return tuple(found)


def _kind_and_type(hint: Any) -> tuple[Kind, Any]:
    """Return the kind of a type, and the type without its words: ``Annotated[float, ...] | None``."""
    if get_origin(hint) is Annotated:
        inner, *words = get_args(hint)
        kind = next((word for word in words if isinstance(word, Kind)), None)
        return (kind, inner) if kind is not None else _kind_and_type(inner)
    if get_origin(hint) is Literal:
        return one_of(get_args(hint)), hint
    kind, bare = _kind_and_type(get_args(hint)[0])
    return kind, bare | None if type(None) in get_args(hint) else bare


def under(folder: Path, entry: Opt, value: Any) -> Any:
    """Return the paths that an option reads below a folder unless they are absolute; other values as is."""
    if entry.kind.is_path and isinstance(value, list | tuple):
        return [under(folder, entry, part) for part in value]
    is_path = entry.kind.is_path and isinstance(value, str | Path) and str(value)
    return folder / Path(value).expanduser() if is_path else value


def unknown(name: str, known: Sequence[str], where: str = "") -> Fault:
    """Return the fault of a name that no option, or key of a file ``where``, has, with the nearest one."""
    by_word = {word.rpartition(".")[2].lstrip("-").replace("_", "-"): word for word in known}
    near = difflib.get_close_matches(name.lstrip("-").replace("_", "-"), by_word, 1)
    step = (
        f"Did you mean {by_word[near[0]]}?"
        if near
        else "docs/options.md lists them all, CHANGELOG.md those that were dropped"
    )
    kind = "key" if where.endswith(".toml") else "option"
    return Fault(name, f"a known {kind}", "an unknown one", where, step)


def with_options(*tables: type[Options]) -> Callable[[_FUNCTION], _FUNCTION]:
    """Show the options of tables in signature and docstring of a function that takes ``**options``."""
    from inspect import Parameter

    def decorate(function: _FUNCTION) -> _FUNCTION:
        own = inspect.signature(function)
        kept = [one for one in own.parameters.values() if one.kind is not Parameter.VAR_KEYWORD]
        every = (entry for table in tables for entry in table.entries())
        listed = [entry for entry in every if entry.name not in own.parameters and not entry.positional]
        added = [
            Parameter(one.name, Parameter.KEYWORD_ONLY, default=one.default, annotation=one.annotation)
            for one in listed
        ]
        function.__signature__ = own.replace(parameters=[*kept, *added])  # type: ignore[attr-defined]
        lines = [f"{entry.name} : {entry.kind.expected}\n    {entry.help}" for entry in listed]
        text = inspect.cleandoc(function.__doc__ or "")
        function.__doc__ = "\n".join([text, "", "Options", "-------", *lines])
        return function

    return decorate


# ---- values as text


def _plain(value: Any) -> Any:
    """Return a value of an option as JSON has it."""
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, WithSd | Path) else value


def toml(value: Any) -> str:
    """Write a value as TOML."""
    if isinstance(value, bool | int | float):
        return repr(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{name} = {toml(entry)}' for name, entry in value.items())} }}"
    return json.dumps(str(value), ensure_ascii=False)


def on_command_line(value: Any, between: str = ",") -> str:
    """Write a value as on the command line; of several rows the first."""
    if isinstance(value, list | tuple):
        first = value[0] if value and isinstance(value[0], list | tuple) else value
        return between.join(map(on_command_line, first))
    return f"{value:g}" if isinstance(value, float) else str(value)


def template(title: str, tables: Sequence[type[Options]]) -> str:
    """Return a study file with every key, its help and an example; only recommended keys are set."""
    lines = [f"# {title}"]
    for table in tables:
        lines += ["", f"[{table.table}]"]
        for entry in table.entries():
            mark = "" if entry.recommended else "# "
            lines += [f"# {entry.help}", f"{mark}{entry.key} = {toml(entry.example)}"]
    return "\n".join(lines) + "\n"


def markdown_table(table: type[Options], flags: bool = True, without: Sequence[str] = ()) -> str:
    """Return options as a Markdown table: name, and meaning with the default.

    With ``flags`` the name is that of the command line, and the key of a study file where that differs;
    without, it is the key.
    """
    lines = ["| option | what it does |", "|-|-|"]
    for entry in (entry for entry in table.entries() if entry.name not in without):
        metavar = "" if entry.is_flag or entry.positional else f" {entry.kind.metavar}"
        name = f"{entry.flag if flags else entry.key}{metavar}"
        name = f"<code>{name.replace('|', '&#124;')}</code>" if "|" in name else f"`{name}`"
        if flags and table.table and entry.key != entry.name:
            name += f", `{entry.key}`"
        lines.append(f"| {name} | {entry.meaning} |")
    return "\n".join(lines) + "\n"
