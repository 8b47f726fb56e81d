"""The parser of a command, made from its tables of options."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from stapeskit.documents import parse_toml
from stapeskit.faults import Fault, StapeskitError, in_words, raise_all
from stapeskit.option_kinds import FLAG, file
from stapeskit.options import Option, OptionTable, Rule, Table, Values, declared, option
from stapeskit.system_faults import why_unreadable
from stapeskit.vocabulary import written

_NUMBERS = re.compile(r"^-(?:[\d.][\d.eE+,\- ]*|[xyz])$")


class Given:
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
        return table(
            **{declaration.field: self._values[declaration.field] for declaration in declared(table)}
        )


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


class Parser(argparse.ArgumentParser):
    """The parser of a command, made from its tables of options.

    Parameters
    ----------
    prog, description, epilog : str
    *tables : type
        Tables of options; positional ones stand in their order.
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
        from stapeskit import __version__

        self.add_argument("--version", action="version", version=f"stapeskit {__version__}")
        self.tables: tuple[type[OptionTable], ...] = (*tables, Terminal)
        self.rules = (*(rule for table in self.tables for rule in table.rules), *rules)
        self.declared = {
            declaration.field: declaration for table in self.tables for declaration in declared(table)
        }
        add_arguments(self, self.declared.values())

    def error(self, message: str) -> NoReturn:
        """Turn a usage fault into the one exception that ends with exit code 2."""
        raise StapeskitError(
            f"{self.prog}: {message.rstrip('.')}. Run {self.prog} --help to see the options."
        )

    def parse(self, arguments: Sequence[str]) -> Given:
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
        texts = {name: value for name, value in vars(known).items() if value not in (None, [])}
        values = {name: declaration.default for name, declaration in self.declared.items()}
        if "config" in texts:
            values |= self._config(Path(texts["config"][-1]), texts, faults)
        for name, given in texts.items():
            self._read(self.declared[name], given, values, faults)
        absent = [
            fault
            for declaration in self.declared.values()
            for fault in declaration.missing_files(values[declaration.field], f"{{{declaration.name}}}")
        ]
        faults += [*absent, *self._check(values, faults)]
        flags = {declaration.name: declaration.flag for declaration in self.declared.values()}
        raise_all(StapeskitError, [in_words(fault, lambda name: flags.get(name, name)) for fault in faults])
        return Given(values)

    def _read(self, declaration: Option, given: Any, values: dict[str, Any], faults: list[Fault]) -> None:
        """Read the texts of an option, and check that the files it names exist."""
        if declaration.kind.is_flag:
            values[declaration.field] = True
            return
        texts = [given] if isinstance(given, str) else given
        texts = texts if declaration.kind.repeats else texts[-1:]
        before = len(faults)
        for text in texts:
            with fault_of(declaration, text, faults):
                declaration.kind.read([text] if declaration.kind.repeats else text)
        if len(faults) == before:
            values[declaration.field] = declaration.kind.read(texts if declaration.kind.repeats else texts[0])

    def _check(self, values: dict[str, Any], faults: list[Fault]) -> list[Fault]:
        """Return what is missing and, where all values are readable, what contradicts itself."""
        missing = [
            Fault(
                f"{{{declaration.name}}}",
                "given",
                "nothing",
                self.prog,
                f"Run {self.prog} --help to see the options",
            )
            for declaration in self.declared.values()
            if declaration.required and values[declaration.field] in (None, ())
        ]
        if faults or missing:
            return missing
        view = Values(values, self.declared.values())
        return [fault for rule in self.rules if (fault := rule.fault(view)) is not None]

    def _join_values(self, words: list[str], faults: list[Fault]) -> list[str]:
        """Join each option to its value, so that a minus does not read as an option: ``--seed=-1,0,2``."""
        options = {
            declaration.flag: declaration
            for declaration in self.declared.values()
            if not declaration.positional and not declaration.kind.is_flag
        }
        joined: list[str] = []
        while words:
            word = words.pop(0)
            if word not in options:
                joined.append(word)
            elif words and (not words[0].startswith("-") or _NUMBERS.match(words[0])):
                joined.append(f"{word}={words.pop(0)}")
            else:
                declaration = options[word]
                faults.append(
                    Fault(
                        f"{{{declaration.name}}}",
                        f"given with a value, {declaration.metavar}",
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
        except OSError:
            return {}
        except ValueError as fault:
            faults.append(Fault("{config}", "valid TOML", fault, path.name))
            return {}
        known = {
            declaration.name: declaration
            for declaration in self.declared.values()
            if declaration.field != "config"
        }
        names = known | {declaration.key: declaration for declaration in known.values()}
        values: dict[str, Any] = {}
        for key, value in table.items():
            declaration = names.get(key.replace("-", "_"))
            if declaration is None:
                close = difflib.get_close_matches(key.replace("-", "_"), known, 1)
                hint = f"Did you mean {close[0].replace('_', '-')}?" if close else ""
                faults.append(Fault("a key of {config}", "an option of the command", key, path.name, hint))
            elif declaration.field not in texts:
                with fault_of(declaration, value, faults, key, path.name):
                    values[declaration.field] = declaration.kind.read(value)
        return values


def add_arguments(parser: argparse.ArgumentParser, options: Iterable[Option]) -> None:
    """Add options to a parser; it keeps the texts, which their kinds read."""
    groups: dict[str, Any] = {"": parser}
    options = list(options)
    flags = {declaration.name: declaration.flag for declaration in options}
    for declaration in options:
        if declaration.group not in groups:
            groups[declaration.group] = parser.add_argument_group(declaration.group)
        help_text = help_of(declaration, flags).replace("%", "%%")
        if declaration.positional:
            count = "*" if declaration.kind.repeats else "?"
            parser.add_argument(declaration.field, nargs=count, metavar=declaration.metavar, help=help_text)
        elif declaration.kind.is_flag:
            groups[declaration.group].add_argument(
                declaration.flag, dest=declaration.field, action="store_const", const=True, help=help_text
            )
        else:
            groups[declaration.group].add_argument(
                declaration.flag,
                dest=declaration.field,
                action="append",
                metavar=declaration.metavar,
                help=help_text,
            )


def help_of(declaration: Option, flags: Mapping[str, str]) -> str:
    """Return the help of an option with its default, references to others as the command writes them."""
    text = written(declaration.help, lambda name: flags.get(name, name))
    if declaration.default in (None, False, "", (), {}):
        return text
    return f"{text} (default {', '.join(declaration.kind.words(declaration.default))})"


@contextmanager
def fault_of(
    declaration: Option, value: Any, faults: list[Fault], thing: str = "", where: str = ""
) -> Iterator[None]:
    """Add the fault of a value that the block finds unfit to the list."""
    try:
        yield
    except (ValueError, TypeError):
        faults.append(declaration.fault(value, thing, where))


def _nearest(word: str, options: Sequence[str]) -> list[str]:
    """Return the option that a mistyped one was meant to be: by its beginning, else by its spelling."""
    longer = [option for option in options if len(word) > 2 and option.startswith(word)]
    names = {option.lstrip("-"): option for option in options}
    close = difflib.get_close_matches(word.lstrip("-"), list(names), 1)
    return longer if len(longer) == 1 else [names[name] for name in close]
