"""The parser of a command, made from its tables of options."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from legacy.stapeskit.faults import Fault, StapeskitError, raise_all, translate_fault
from legacy.stapeskit.json_toml import parse_toml
from legacy.stapeskit.option_declaration import Option, option
from legacy.stapeskit.option_kinds import FLAG, file, output
from legacy.stapeskit.option_names import suggestion, written
from legacy.stapeskit.option_rules import Rule, Values
from legacy.stapeskit.options import OptionTable, Table, declared
from legacy.stapeskit.system_faults import why_unreadable

_NUMBERS = re.compile(r"^-(?:[\d.][\d.eE+,\- ]*|[xyz])$")


class ParsedOptions:
    """What a command line and its config file give: the values of every option, by field."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = dict(values)

    def __getattr__(self, name: str) -> Any:
        try:
            return self._values[name]
        except KeyError:
            raise AttributeError(name) from None

    def make(self, table: type[Table]) -> Table:
        """Return a table of options out of the values."""
        return table(**{entry.field: self._values[entry.field] for entry in declared(table)})


@dataclass(frozen=True)
class Terminal(OptionTable):
    """Options that every command has."""

    title = "every command"

    config: Path | None = option(
        file("TOML file"),
        "options from a TOML file, by their names; the command line wins",
        metavar="FILE.toml",
        example="options.toml",
    )
    quiet: bool = option(FLAG, "print faults only", False)
    json: bool = option(FLAG, "print the result as JSON instead of a table", False)
    log: Path | None = option(
        output(".log"),
        "append to this file what was run, with what, every message and how it ended",
        example="ear1.log",
    )


class Parser(argparse.ArgumentParser):
    """The parser of a command, made from its tables of options.

    Parameters
    ----------
    *tables : type
        Tables of options; positional options keep their order.
    rules : tuple of Rule
        What options of different tables must not say together.
    """

    def __init__(
        self,
        prog: str,
        description: str,
        epilog: str,
        *tables: type[OptionTable],
        rules: tuple[Rule, ...] = (),
    ) -> None:
        super().__init__(
            prog=prog,
            description=description,
            epilog=epilog,
            allow_abbrev=False,
            exit_on_error=False,
            formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, 2, 26, 80),
        )
        from legacy.stapeskit import __version__

        self.add_argument("--version", action="version", version=f"stapeskit {__version__}")
        self.tables: tuple[type[OptionTable], ...] = (*tables, Terminal)
        self.rules = (*(rule for table in self.tables for rule in table.rules), *rules)
        self.declared = {entry.field: entry for table in self.tables for entry in declared(table)}
        add_arguments(self, self.declared.values())

    def error(self, message: str) -> NoReturn:
        """Turn a usage fault into the one exception that ends with exit code 2."""
        raise StapeskitError(
            f"{self.prog}: {message.rstrip('.')}. Run {self.prog} --help to see the options."
        )

    def parse(self, arguments: Sequence[str]) -> ParsedOptions:
        """Parse a command line.

        Raises
        ------
        StapeskitError
            Options are unknown (the nearest are named), lack their values, have unfit ones, name files that
            do not exist or contradict each other; all of them together.
        """
        faults: list[Fault] = []
        words = self._join_values(list(arguments), faults)
        try:
            known, unknown = self.parse_known_args(words)
        except argparse.ArgumentError as fault:
            self.error(str(fault))
        options = [word for word in unknown if word.startswith("-")]
        faults += [self._unknown(word) for word in options or unknown]
        texts = {name: _words(value) for name, value in vars(known).items() if value not in (None, [])}
        values = {name: entry.default for name, entry in self.declared.items()}
        if "config" in texts:
            values |= self._config(Path(texts["config"][-1]), texts, faults)
        for name, text in texts.items():
            self._read(self.declared[name], text, values, faults)
        absent = [
            fault
            for entry in self.declared.values()
            for fault in entry.missing_files(values[entry.field], f"{{{entry.name}}}")
        ]
        faults += [*absent, *self._check(values, faults)]
        flags = {entry.name: entry.flag for entry in self.declared.values()}
        raise_all(
            StapeskitError, [translate_fault(fault, lambda name: flags.get(name, name)) for fault in faults]
        )
        if values["log"] is not None:
            from legacy.stapeskit.run_log import begin

            begin(values["log"], self.prog, tuple(arguments))
        return ParsedOptions(values)

    def _read(self, entry: Option, value: Any, values: dict[str, Any], faults: list[Fault]) -> None:
        """Read the texts of an option, and check that the files it names exist."""
        if entry.kind.is_flag:
            values[entry.field] = True
            return
        texts = [value] if isinstance(value, str) else value
        if not entry.kind.repeats and len(set(texts)) > 1:
            step = "Leave all but one of them out"
            faults.append(Fault(f"{{{entry.name}}}", "given once", " and ".join(texts), self.prog, step))
            return
        texts = texts if entry.kind.repeats else texts[-1:]
        before = len(faults)
        for text in texts:
            entry.read(text, faults)
        if len(faults) == before:
            values[entry.field] = entry.kind.read(texts if entry.kind.repeats else texts[0])

    def _check(self, values: dict[str, Any], faults: list[Fault]) -> list[Fault]:
        """Return what is missing and, where all values are readable, what contradicts itself."""
        missing = [
            Fault(
                f"{{{entry.name}}}",
                "given",
                "nothing",
                self.prog,
                f"Run {self.prog} --help to see the options",
            )
            for entry in self.declared.values()
            if entry.required and values[entry.field] in (None, ())
        ]
        if faults or missing:
            return missing
        view = Values(values, self.declared.values())
        return [fault for rule in self.rules if (fault := rule.fault(view)) is not None]

    def _join_values(self, words: list[str], faults: list[Fault]) -> list[str]:
        """Join each option to its value, so that a minus does not read as an option: ``--seed=-1,0,2``."""
        options = {
            entry.flag: entry
            for entry in self.declared.values()
            if not entry.positional and not entry.kind.is_flag
        }
        joined: list[str] = []
        while words:
            word = words.pop(0)
            if word not in options:
                joined.append(word)
            elif words and (not words[0].startswith("-") or _NUMBERS.match(words[0])):
                joined.append(f"{word}={words.pop(0)}")
            else:
                entry = options[word]
                faults.append(
                    Fault(
                        f"{{{entry.name}}}",
                        f"given with a value, {entry.metavar}",
                        "none",
                        self.prog,
                    )
                )
        return joined

    def _unknown(self, word: str) -> Fault:
        options = [text for action in self._actions for text in action.option_strings]
        close = _nearest(word.split("=")[0], options)
        hint = f"Did you mean {close[0]}?" if close else f"Run {self.prog} --help to see the options"
        return Fault(word, "a known option or argument", "an unknown one", self.prog, hint)

    def _config(self, path: Path, texts: Mapping[str, Any], faults: list[Fault]) -> dict[str, Any]:
        """Read the options of a config file that the command line does not give."""
        if why_unreadable(path):
            return {}
        try:
            table = parse_toml(path.read_text(encoding="utf-8-sig"))
        except (OSError, ValueError) as fault:
            got = fault.strerror if isinstance(fault, OSError) else fault
            faults.append(Fault("{config}", "valid TOML", got, path.name))
            return {}
        known = {entry.name: entry for entry in self.declared.values() if entry.field != "config"}
        names = known | {entry.key: entry for entry in known.values()}
        values: dict[str, Any] = {}
        for key, value in table.items():
            entry = names.get(key.replace("-", "_"))
            if entry is None:
                word = key.replace("-", "_")
                hint = suggestion(word, [f"no_{word}"] if f"no_{word}" in known else known).replace("_", "-")
                faults.append(Fault("a key of {config}", "an option of the command", key, path.name, hint))
            elif entry.field not in texts:
                values[entry.field] = entry.read(value, faults, key, path.name)
        return values


def _words(value: Any) -> Any:
    """Return the texts of an option; argparse of Python 3.11 makes an empty list of the value ``--``."""
    return [word if isinstance(word, str) else "--" for word in value] if isinstance(value, list) else value


def add_arguments(parser: argparse.ArgumentParser, options: Iterable[Option]) -> None:
    """Add options to a parser; it keeps the texts, which their kinds read."""
    groups: dict[str, Any] = {"": parser}
    options = list(options)
    flags = {entry.name: entry.flag for entry in options}
    for entry in options:
        if entry.group not in groups:
            groups[entry.group] = parser.add_argument_group(entry.group)
        help_text = help_of(entry, flags).replace("%", "%%")
        if entry.positional:
            count = "*" if entry.kind.repeats else "?"
            parser.add_argument(entry.field, nargs=count, metavar=entry.metavar, help=help_text)
        elif entry.kind.is_flag:
            groups[entry.group].add_argument(
                entry.flag, dest=entry.field, action="store_const", const=True, help=help_text
            )
        else:
            groups[entry.group].add_argument(
                entry.flag,
                dest=entry.field,
                action="append",
                metavar=entry.metavar,
                help=help_text,
            )


def help_of(entry: Option, flags: Mapping[str, str]) -> str:
    """Return the help of an option with its default, references to others as the command writes them."""
    text = written(entry.help, lambda name: flags.get(name, name))
    if entry.default in (None, False, "", (), {}):
        return text
    return f"{text} (default {', '.join(entry.kind.words(entry.default))})"


def _nearest(word: str, options: Sequence[str]) -> list[str]:
    """Return the option that a mistyped one was meant to be: by its beginning, else by its spelling."""
    longer = [option for option in options if len(word) > 2 and option.startswith(word)]
    names = {option.lstrip("-"): option for option in options}
    close = difflib.get_close_matches(word.lstrip("-"), list(names), 1)
    return longer if len(longer) == 1 else [names[name] for name in close]
