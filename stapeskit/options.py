"""Options of the commands, declared once: command line, --config, study files, Python, help, template, page.

A table of options is a pydantic model. A field's name is its key in a study file (``box_mm``); `Opt.name`,
by default the key without its unit, is the flag and the keyword in Python (``--box``, ``box=``).
All faults of what a user gives come together.

    class ScanOptions(Options):
        table = "scan"
        file: Annotated[ReadFile | None, Opt("volume, folder of slices or mesh", positional=True)] = None
        box_mm: Annotated[Box | None, Opt("part to look at, scan mm", "find", [0, 0, 0, 8, 8, 6])] = None
"""

from __future__ import annotations

import argparse
import difflib
import inspect
import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError

from stapeskit.faults import Fault, StapeskitError, raise_all
from stapeskit.option_types import Says, WithSd

_UNIT = re.compile(r"_(mm|um|hz|kg_m3|percent|deg|us|db)$")
_STARTS_WITH_MINUS = re.compile(r"-[\d.xyz]")
_LONGEST_FILE = 10_000_000  # bytes of a TOML file
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
    study : bool
        Whether a study file may hold it.
    """

    help: str
    group: str = ""
    example: Any = None
    name: str = ""
    positional: bool = False
    repeats: bool = False
    recommended: bool = False
    study: bool = True


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


class Options(BaseModel):
    """A table of options; ``table`` names it in a study file."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)
    table: ClassVar[str] = ""
    rules: ClassVar[tuple[Rule, ...]] = ()

    @classmethod
    def entries(cls) -> Iterator[Entry]:
        """Yield every option of the table."""
        for key, field in cls.model_fields.items():
            opt = next(part for part in field.metadata if isinstance(part, Opt))
            yield Entry(
                key, opt.name or _UNIT.sub("", key), opt, _says(field), field.annotation, field.default
            )

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
        try:
            made = cls.model_validate(dict(values), context={"folder": folder or Path()})
        except ValidationError as error:
            faults = [cls._fault(found, where, called) for found in error.errors(include_url=False)]
            raise StapeskitError(*dict.fromkeys(faults)) from None
        broken = [rule.fault for rule in cls.rules if rule.breaks(made)]
        raise_all(fault if isinstance(fault, Fault) else fault(made) for fault in broken)
        return made

    @classmethod
    def _fault(cls, error: Any, where: str, called: Mapping[str, str]) -> Fault:
        key = str(error["loc"][0])
        if error["type"] == "extra_forbidden":
            return unknown(key, list(called.values()), where)
        entry = next(entry for entry in cls.entries() if entry.key == key)
        if error["type"] == "missing":
            return Fault(called[key], "given", "nothing", where)
        return entry.fault(error["input"], called[key], where)

    @classmethod
    def from_study(cls, values: Mapping[str, Any], file: str, folder: Path) -> Self:
        """Make the table from its part of a study file; relative paths are relative to its folder.

        Raises
        ------
        StapeskitError
            As `read`.
        """
        called = {entry.key: f"{cls.table}.{entry.key}" for entry in cls.entries()}
        return cls.read(values, file, called, folder)

    def given(self) -> dict[str, Any]:
        """Return what differs from its default, by key, as JSON has it: for the provenance of a result."""
        return {
            entry.key: plain(getattr(self, entry.key))
            for entry in self.entries()
            if getattr(self, entry.key) != entry.default
        }


@dataclass(frozen=True)
class Entry:
    """An option of a table: key in a study, name elsewhere, `Opt`, words of its type, type, default."""

    key: str
    name: str
    opt: Opt
    says: Says
    annotation: Any
    default: Any

    @property
    def flag(self) -> str:
        """The name on the command line."""
        return self.name.upper() if self.opt.positional else "--" + self.name.replace("_", "-")

    @property
    def is_flag(self) -> bool:
        """Whether it takes no value on the command line."""
        return bool in (self.annotation, *get_args(self.annotation))

    def fault(self, got: Any, called: str, where: str = "") -> Fault:
        """Return the fault of an unfit value."""
        text = str(got[0] if isinstance(got, list) and len(got) == 1 else got)
        step = self.says.step
        if re.fullmatch(r"\d+,\d+", text):
            step = f"Write a decimal point: {text.replace(',', '.')}"
        if not step and (self.opt.example is not None or self.default is not None):
            example = self.default if self.opt.example is None else self.opt.example
            step = (
                f"Write for example {_on_command_line(example) if called.startswith('--') else toml(example)}"
            )
        return Fault(called, self.says.expected, text, where, step)


def unknown(name: str, known: Sequence[str], where: str = "") -> Fault:
    """Return the fault of a name that no option has, with the nearest one."""
    by_word = {word.lstrip("-").replace("_", "-"): word for word in known}
    near = difflib.get_close_matches(name.lstrip("-").replace("_", "-"), by_word, 1)
    step = f"Did you mean {by_word[near[0]]}?" if near else ""
    return Fault(name, "a known option", "an unknown one", where, step)


def _says(field: Any) -> Says:
    for part in (*field.metadata, *get_args(field.annotation), field.annotation):
        words = [found for found in getattr(part, "__metadata__", (part,)) if isinstance(found, Says)]
        if words:
            return words[-1]
        if get_origin(part) is Literal:
            choices = [str(choice) for choice in get_args(part)]
            return Says(f"one of {', '.join(choices)}", "|".join(choices))
    raise TypeError(f"the type {field.annotation} has no words")


def parse(
    prog: str, text: str, tables: Sequence[type[Options]], words: Sequence[str], epilog: str = ""
) -> list[Any]:
    """Read a command line into its tables.

    Every command has ``--config FILE.toml`` (options by name; the command line wins) and ``--version``.

    Raises
    ------
    StapeskitError
        Every fault of the command line and of the file of ``--config``.
    """
    parser = _parser(prog, text, tables, epilog)
    flags = {entry.flag: entry for table in tables for entry in table.entries() if not entry.opt.positional}
    try:
        known, rest = parser.parse_known_args(_join_minus(words, flags))
    except argparse.ArgumentError as error:
        raise StapeskitError(f"{prog}: {error}") from None
    given = vars(known)
    names = {
        name: entry.key for table in tables for entry in table.entries() for name in (entry.name, entry.key)
    }
    values_of_unknown = {after for before, after in itertools.pairwise(rest) if before.startswith("--")}
    wrong = [word for word in rest if word.startswith("-") or word not in values_of_unknown]
    faults = [unknown(word.split("=")[0], list(flags)) for word in wrong]
    for entry in (entry for table in tables for entry in table.entries()):
        if isinstance(value := given.get(entry.key), list) and not entry.opt.repeats:
            if len(set(value)) > 1:
                faults.append(Fault(entry.flag, "given once", " and ".join(value)))
            given[entry.key] = value[-1]
    config = given.pop("config", None)
    from_file = {}
    if config is not None:
        from_file = _from_config(Path(config), tables)
        every = set(names.values())
        faults += [unknown(name, [*names], config) for name in from_file if name not in every]
    made = []
    for table in tables:
        keys = {entry.key: entry.flag for entry in table.entries()}
        values = {key: value for key, value in {**from_file, **given}.items() if key in keys}
        try:
            made.append(table.read(values, "", keys))
        except StapeskitError as error:
            faults += error.faults
    raise_all(faults)
    return made


def _from_config(path: Path, tables: Sequence[type[Options]]) -> dict[str, Any]:
    """Return the values of a TOML file by key; relative paths are made relative to its folder."""
    every = [entry for table in tables for entry in table.entries()]
    options = {name: entry for entry in every for name in (entry.name, entry.key)}
    values = {}
    for name, value in read_toml(path).items():
        entry = options.get(name.replace("-", "_"))
        if entry is not None and entry.says.is_path and isinstance(value, list):
            value = [str(path.parent / str(part)) for part in value]
        elif entry is not None and entry.says.is_path and isinstance(value, str):
            value = str(path.parent / value)
        values[name if entry is None else entry.key] = value
    return values


def _parser(prog: str, text: str, tables: Sequence[type[Options]], epilog: str) -> argparse.ArgumentParser:
    from stapeskit import __version__

    def formatter(prog: str) -> argparse.HelpFormatter:
        return argparse.RawDescriptionHelpFormatter(prog, 2, 26, 80)

    parser = argparse.ArgumentParser(
        prog=prog,
        description=text,
        epilog=epilog,
        allow_abbrev=False,
        exit_on_error=False,
        formatter_class=formatter,
    )
    parser.add_argument("--version", action="version", version=f"{prog} {__version__}")
    help_text = "options from a TOML file; the command line wins"
    parser.add_argument("--config", metavar="FILE.toml", default=argparse.SUPPRESS, help=help_text)
    groups: dict[str, Any] = {"": parser}
    for entry in (entry for table in tables for entry in table.entries()):
        if entry.opt.group not in groups:
            groups[entry.opt.group] = parser.add_argument_group(entry.opt.group)
        more: dict[str, Any] = {"help": entry.opt.help.replace("%", "%%"), "default": argparse.SUPPRESS}
        if entry.opt.positional:
            nargs = "*" if entry.opt.repeats else "?"
            parser.add_argument(entry.key, nargs=nargs, metavar=entry.name.upper(), **more)
        elif entry.is_flag:
            groups[entry.opt.group].add_argument(entry.flag, dest=entry.key, action="store_true", **more)
        else:
            more |= {"metavar": entry.says.metavar, "action": "append", "dest": entry.key}
            groups[entry.opt.group].add_argument(entry.flag, **more)
    return parser


def _join_minus(words: Sequence[str], flags: Mapping[str, Entry]) -> list[str]:
    """Join ``--anterior -1,0,0`` to ``--anterior=-1,0,0``, so that the value is not taken for an option."""
    joined: list[str] = []
    for word in words:
        before = flags.get(joined[-1]) if joined else None
        if before is not None and not before.is_flag and _STARTS_WITH_MINUS.match(word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


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
        listed = [entry for table in tables for entry in table.entries() if entry.name not in own.parameters]
        keyword = inspect.Parameter.KEYWORD_ONLY
        added = [
            inspect.Parameter(entry.name, keyword, default=entry.default, annotation=_bare(entry.annotation))
            for entry in listed
            if not entry.opt.positional
        ]
        function.__signature__ = own.replace(parameters=[*kept, *added])  # type: ignore[attr-defined]
        lines = [f"    {entry.name} : {entry.says.expected}\n        {entry.opt.help}" for entry in listed]
        function.__doc__ = f"{inspect.cleandoc(function.__doc__ or '')}\n\nOptions\n-------\n" + "\n".join(
            lines
        )
        return function

    return decorate


def _bare(annotation: Any) -> Any:
    """Return a type without its words: ``Annotated[float, ...] | None`` as ``float | None``."""
    if get_origin(annotation) is Annotated:
        return _bare(get_args(annotation)[0])
    parts = get_args(annotation)
    if type(None) in parts:
        first = next(part for part in parts if part is not type(None))
        return _bare(first) | None
    return annotation


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


def _on_command_line(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ",".join(
            map(_on_command_line, value[0] if value and isinstance(value[0], list | tuple) else value)
        )
    return str(value)


def template(title: str, tables: Sequence[type[Options]]) -> str:
    """Return a study file with every key, its help and an example; only recommended keys are set."""
    lines = [f"# {title}"]
    for table in tables:
        lines += ["", f"[{table.table}]"]
        for entry in table.entries():
            if entry.opt.study:
                example = entry.default if entry.opt.example is None else entry.opt.example
                mark = "" if entry.opt.recommended else "# "
                lines += [f"# {entry.opt.help}", f"{mark}{entry.key} = {toml(example)}"]
    return "\n".join(lines) + "\n"


def markdown_table(tables: Sequence[type[Options]]) -> str:
    """Return the options of a command as a Markdown table: command line, study file, meaning, default."""
    lines = ["| command line | study file | what it does | default |", "|---|---|---|---|"]
    for table in tables:
        for entry in table.entries():
            metavar = "" if entry.is_flag or entry.opt.positional else f" {entry.says.metavar}"
            key = f"`{table.table}.{entry.key}`" if table.table and entry.opt.study else ""
            default = (
                "" if entry.default in (None, False, ()) else f"`{_on_command_line(plain(entry.default))}`"
            )
            cells = (f"`{entry.flag}{metavar}`", key, entry.opt.help, default)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
