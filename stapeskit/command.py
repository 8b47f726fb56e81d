"""What the four commands share: options, a config file, one-sentence faults, exit codes, a short table.

A command is parse -> read -> one library call -> write -> a table. Exit 0 done, 2 the input is at fault,
1 a bug in stapeskit, 130 interrupted.
"""

from __future__ import annotations

import argparse
import difflib
import json
import re
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from stapeskit.faults import Fault, StapeskitError, collecting, raise_all
from stapeskit.warnings import Notice

_CHOICE = re.compile(r"argument (\S+): invalid choice: '?(.*?)'? \(choose from (.*)\)", re.DOTALL)
_NO_NUMBER = re.compile(r"argument (\S+): invalid (int|float) value: '(.*)'", re.DOTALL)
_NUMBERS = re.compile(r"^-(?:[\d.][\d.eE+,\- ]*|[xyz])$")


@dataclass(frozen=True)
class Outcome:
    """What a command has to tell: table rows (label, text), notices, files written, the full result."""

    title: str
    rows: Sequence[tuple[str, str]]
    notices: Sequence[Notice] = ()
    files: Sequence[Path] = ()
    result: dict[str, Any] = field(default_factory=dict)


class Parser(argparse.ArgumentParser):
    """argparse with one-sentence faults, near misses named, a config file and minus-led comma lists."""

    def __init__(self, prog: str, description: str, epilog: str = "") -> None:
        super().__init__(
            prog=prog,
            description=description,
            epilog=epilog,
            allow_abbrev=False,
            exit_on_error=False,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        from stapeskit import __version__

        self.add_argument("--version", action="version", version=f"stapeskit {__version__}")
        self.add_argument("--quiet", action="store_true", help="print faults only")
        self.add_argument("--json", action="store_true", help="print the result as JSON instead of a table")

    def add_config(self) -> None:
        """Add ``--config FILE.toml``: every long option may stand there by its name; the line wins."""
        self.add_argument(
            "--config", type=Path, metavar="FILE.toml", help="options from a TOML file; the command line wins"
        )

    def add_force(self) -> None:
        """Add ``--force``."""
        self.add_argument(
            "--force",
            action="store_true",
            help="replace files at the names of outputs that this command did not write, or that were edited",
        )

    def error(self, message: str) -> NoReturn:
        """Turn a usage fault into the one exception that ends with exit code 2."""
        raise StapeskitError(self._fault(message))

    def _fault(self, message: str) -> Fault:
        """Return what argparse says as a fault."""
        found = _CHOICE.fullmatch(message)
        if found:
            option, got, choices = found.groups()
            expected = "one of " + choices.replace("'", "")
            return Fault(f"{self.prog}: {option.split('/')[-1]}", expected, got)
        found = _NO_NUMBER.fullmatch(message)
        if found:
            option, kind, got = found.groups()
            expected = "a whole number" if kind == "int" else "a number"
            return Fault(f"{self.prog}: {option.split('/')[-1]}", expected, got)
        return Fault(f"{self.prog}: {message.rstrip('.')}. Run {self.prog} --help to see the options.")

    def parse(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Parse a command line.

        Raises
        ------
        StapeskitError
            Options are unknown (the nearest are named), lack their values or have impossible ones; all of
            them together.
        """
        words = _join_minus_lists(list(arguments), self._value_options())
        faults: list[Fault] = []
        config = self._config_path(words)
        if config is not None:
            with collecting(faults):
                self.set_defaults(**self._config(config, faults))
        known, unknown = argparse.Namespace(), [""]
        while unknown == [""]:
            try:
                known, unknown = self.parse_known_args(words)
            except argparse.ArgumentError as fault:
                action = self._action_of(fault)
                if action is None:
                    faults.append(self._fault(str(fault)))
                    break
                action.required = False
                words = self._without(words, action, fault, faults)
            except StapeskitError as fault:
                faults += fault.faults
                break
        options = [word for word in unknown if word.startswith("-")]
        faults += [self._unknown(word) for word in options or unknown if word]
        raise_all(StapeskitError, faults)
        return known

    def _action_of(self, fault: argparse.ArgumentError) -> argparse.Action | None:
        """Return the option that a fault is about; None for another argument."""
        names = (fault.argument_name or "").split("/")
        return next((one for one in self._actions if set(names) & set(one.option_strings)), None)

    def _without(
        self, words: list[str], action: argparse.Action, fault: argparse.ArgumentError, faults: list[Fault]
    ) -> list[str]:
        """Take an option out of the words, and tell what is wrong with each time it is given."""
        left: list[str] = []
        told = len(faults)
        place = 0
        while place < len(words):
            name, equals, value = words[place].partition("=")
            place += 1
            if name not in action.option_strings:
                left.append(words[place - 1])
                continue
            if not equals:
                if action.nargs is not None or place == len(words) or words[place].startswith("--"):
                    faults.append(self._fault(str(fault)))
                    continue
                value = words[place]
                place += 1
            try:
                self._get_values(action, [value])
            except argparse.ArgumentError as wrong:
                faults.append(self._fault(str(wrong)))
        if len(faults) == told:
            faults.append(self._fault(str(fault)))
        return left

    def _value_options(self) -> set[str]:
        return {text for action in self._actions if action.nargs != 0 for text in action.option_strings}

    def _unknown(self, word: str) -> Fault:
        options = [text for action in self._actions for text in action.option_strings]
        near = _nearest(word.split("=")[0], options)
        hint = f"Did you mean {near[0]}?" if near else f"Run {self.prog} --help to see the options."
        return Fault(f"{self.prog}: {word}", "a known option or argument", "an unknown one", "", hint)

    def _config_path(self, words: list[str]) -> Path | None:
        for place, word in enumerate(words):
            if word == "--config" and place + 1 < len(words):
                return Path(words[place + 1])
            if word.startswith("--config="):
                return Path(word.split("=", 1)[1])
        return None

    def _config(self, path: Path, faults: list[Fault]) -> dict[str, Any]:
        import tomllib

        if not path.is_file():
            raise StapeskitError(Fault("--config", "an existing TOML file", path))
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as fault:
            raise StapeskitError(Fault("--config", "valid TOML", fault, path.name)) from fault
        actions = {action.dest: action for action in self._actions if action.option_strings}
        defaults: dict[str, Any] = {}
        for key, value in table.items():
            name = key.replace("-", "_")
            if name not in actions or name in ("config", "help", "version"):
                near = difflib.get_close_matches(name, actions, 1)
                hint = f"Did you mean {near[0].replace('_', '-')}?" if near else ""
                faults.append(Fault("a key of --config", "an option of the command", key, path.name, hint))
                continue
            with collecting(faults):
                defaults[name] = self._config_value(actions[name], value, key, path)
            actions[name].required = False
        return defaults

    def _config_value(self, action: argparse.Action, value: Any, key: str, path: Path) -> Any:
        if action.nargs == 0:
            if not isinstance(value, bool):
                raise StapeskitError(Fault(key, "true or false", value, path.name))
            return value
        repeated = isinstance(action, argparse._AppendAction)
        entries = value if isinstance(value, list) and (repeated and not _is_numbers(value)) else [value]
        texts = [",".join(map(str, entry)) if isinstance(entry, list) else str(entry) for entry in entries]
        try:
            read = [self._get_value(action, text) for text in texts]
        except argparse.ArgumentError as fault:
            found = _NO_NUMBER.fullmatch(str(fault))
            if found:
                expected = "a whole number" if found[2] == "int" else "a number"
                raise StapeskitError(Fault(key, expected, value, path.name)) from fault
            raise StapeskitError(f"{fault} ({path.name}).") from fault
        if action.choices is not None and any(entry not in action.choices for entry in read):
            raise StapeskitError(
                Fault(key, f"one of {', '.join(map(str, action.choices))}", value, path.name)
            )
        return read if repeated else read[0]


def _nearest(word: str, options: Sequence[str]) -> list[str]:
    """Return the option that a mistyped one was meant to be: by its beginning, else by its spelling."""
    longer = [option for option in options if len(word) > 2 and option.startswith(word)]
    names = {option.lstrip("-"): option for option in options}
    close = difflib.get_close_matches(word.lstrip("-"), list(names), 1)
    return longer if len(longer) == 1 else [names[name] for name in close]


def _is_numbers(value: list[Any]) -> bool:
    return bool(value) and all(isinstance(entry, int | float) for entry in value)


def _join_minus_lists(words: list[str], value_options: set[str]) -> list[str]:
    """Join ``--option -0.9,0.1,0`` (or ``-z``) to one word, so that a minus does not read as an option."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] in value_options and _NUMBERS.match(word):
            joined[-1] = f"{joined[-1]}={word}"
        else:
            joined.append(word)
    return joined


def numbers(count: int | tuple[int, ...], name: str = "the value") -> Callable[[str], tuple[float, ...]]:
    """Return a converter of comma lists to that many finite numbers."""
    counts = (count,) if isinstance(count, int) else count

    def convert(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        finite = all(abs(value) < float("inf") for value in values)
        if len(values) not in counts or not finite:
            wanted = " or ".join(str(entry) for entry in counts)
            raise argparse.ArgumentTypeError(
                f"{name} must be {wanted} finite numbers separated by commas; got {text}"
            )
        return values

    return convert


def value_with_sd(text: str) -> tuple[float, float | None]:
    """Read ``VALUE`` or ``VALUE+-SD``; SD None when not given."""
    parts = text.replace("±", "+-").split("+-")
    try:
        value = float(parts[0])
        sd = float(parts[1]) if len(parts) == 2 else None
    except ValueError:
        parts = []
    if (
        len(parts) not in (1, 2)
        or not 0.0 < value < float("inf")
        or (sd is not None and not 0.0 <= sd < float("inf"))
    ):
        raise argparse.ArgumentTypeError(f"the value must be a positive number, or number+-sd; got {text}")
    return value, sd


def run(prog: str, work: Callable[[list[str]], tuple[Any, Outcome] | None]) -> NoReturn:
    """Run a command's work and leave the process with its exit code.

    Parameters
    ----------
    prog : str
        The command's name.
    work : callable
        Takes the arguments, returns the options and the outcome, or None when it has printed already.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        done = work(sys.argv[1:])
        if done is not None:
            options, outcome = done
            show(options, outcome)
        sys.stdout.flush()
        code = 0
    except StapeskitError as fault:
        sys.stderr.write(f"{fault}\n")
        code = 2
    except KeyboardInterrupt as stop:
        sys.stderr.write(f"{prog}: {stop if str(stop) else 'interrupted; nothing was written.'}\n")
        code = 130
    except BrokenPipeError:
        code = 0
    except MemoryError:
        sys.stderr.write(f"{prog}: not enough memory; crop the scan with --box or close other programs.\n")
        code = 2
    except Exception:
        traceback.print_exc()
        sys.stderr.write(f"{prog}: this is a bug in stapeskit; please report it with the lines above.\n")
        code = 1
    raise SystemExit(code)


def _interrupt(_signal: int, _frame: object) -> NoReturn:
    raise KeyboardInterrupt


def show(options: Any, outcome: Outcome) -> None:
    """Print an outcome: JSON, or a table of its rows; notices go to standard error."""
    if not options.quiet:
        for notice in outcome.notices:
            sys.stderr.write(f"warning [{notice.code}] {notice.text}\n")
    if options.json:
        sys.stdout.write(json.dumps(outcome.result, indent=1) + "\n")
    elif not options.quiet:
        width = max((len(label) for label, _ in outcome.rows), default=0)
        lines = [outcome.title, *(f"  {label:<{width}}  {text}" for label, text in outcome.rows)]
        if outcome.files:
            lines.append("  written: " + ", ".join(str(path) for path in outcome.files))
        sys.stdout.write("\n".join(lines) + "\n")
