"""Read a command line into tables of options; all of its faults come together."""

from __future__ import annotations

import argparse
import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stapeskit.documents import read_toml
from stapeskit.faults import Fault, StapeskitError, collect_faults, raise_all
from stapeskit.options import Opt, Options, under, unknown

_STARTS_WITH_MINUS = re.compile(r"-[\d.xyz]")


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
    entries = [entry for table in tables for entry in table.entries()]
    flags = [entry.flag for entry in entries if not entry.positional]
    takes_value = {entry.flag for entry in entries if not entry.positional and not entry.is_flag}
    joined: list[str] = []
    for word in words:  # "--anterior -1,0,0" to "--anterior=-1,0,0", which is not taken for an option
        if joined and joined[-1] in takes_value and _STARTS_WITH_MINUS.match(word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    try:
        known, rest = _parser(prog, text, entries, epilog).parse_known_args(joined)
    except argparse.ArgumentError as error:
        alone = error.message.startswith("expected")
        expected, got = ("followed by a value", "nothing") if alone else ("as its help shows", error.message)
        raise StapeskitError.of(
            error.argument_name or prog, expected, got, "", f"See {prog} --help"
        ) from None
    given = vars(known)
    values_of_unknown = {after for before, after in itertools.pairwise(rest) if before.startswith("--")}
    wrong = [word for word in rest if word.startswith("-") or word not in values_of_unknown]
    faults = [
        unknown(word.split("=")[0], flags)
        if word.startswith("-")
        else Fault(word, "the value of an option", "a word on its own", "", f"See {prog} --help")
        for word in wrong
    ]
    for entry in entries:
        if isinstance(value := given.get(entry.key), list) and not entry.repeats:
            if len(set(value)) > 1:
                faults.append(Fault(entry.flag, "given once", " and ".join(value)))
            given[entry.key] = value[-1]
    config = given.pop("config", None)
    if config is not None:
        options = {name: entry for entry in entries for name in (entry.key, entry.name)}
        for name, value in read_toml(Path(config)).items():
            found = options.get(name.replace("-", "_"))
            if found is None:
                faults.append(unknown(name, list(options), config))
            else:
                given.setdefault(found.key, under(Path(config).parent, found, value))
    made = []
    for table in tables:
        called = {entry.key: entry.flag for entry in table.entries()}
        with collect_faults(faults):
            made.append(table.read({key: given[key] for key in called if key in given}, "", called))
    raise_all(faults)
    return made


def _parser(prog: str, text: str, entries: Sequence[Opt], epilog: str) -> argparse.ArgumentParser:
    from stapeskit import __version__

    parser = argparse.ArgumentParser(
        prog=prog,
        description=text,
        epilog=epilog,
        allow_abbrev=False,
        exit_on_error=False,
        argument_default=argparse.SUPPRESS,
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, 2, 26, 80),
    )
    parser.color = False  # type: ignore[attr-defined]  # of Python 3.14; the streams of a command drop its codes
    parser.add_argument("--version", action="version", version=f"{prog} {__version__}")
    help_text = "options from a TOML file; the command line wins"
    parser.add_argument("--config", metavar="FILE.toml", help=help_text)
    groups: dict[str, Any] = {"": parser}
    for entry in entries:
        if entry.group not in groups:
            groups[entry.group] = parser.add_argument_group(entry.group)
        help_text = entry.meaning.replace("%", "%%")
        if entry.positional:
            nargs = "*" if entry.repeats else "?"
            parser.add_argument(entry.key, nargs=nargs, metavar=entry.flag, help=help_text)
        elif entry.is_flag:
            groups[entry.group].add_argument(entry.flag, dest=entry.key, action="store_true", help=help_text)
        else:
            more = {"metavar": entry.kind.metavar, "action": "append", "dest": entry.key, "help": help_text}
            groups[entry.group].add_argument(entry.flag, **more)
    return parser
