"""Read a command line into tables of options; all of its faults come together."""

from __future__ import annotations

import argparse
import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stapeskit.faults import Fault, StapeskitError, collect_faults, raise_all
from stapeskit.options import Entry, Options, read_toml, under, unknown

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
    flags = {entry.flag: entry for entry in entries if not entry.opt.positional}
    parser = _parser(prog, text, entries, epilog)
    try:
        known, rest = parser.parse_known_args(_join_minus(words, flags))
    except argparse.ArgumentError as error:
        raise StapeskitError(f"{prog}: {error}") from None
    given = vars(known)
    values_of_unknown = {after for before, after in itertools.pairwise(rest) if before.startswith("--")}
    wrong = [word for word in rest if word.startswith("-") or word not in values_of_unknown]
    faults = [unknown(word.split("=")[0], list(flags)) for word in wrong]
    for entry in entries:
        if isinstance(value := given.get(entry.key), list) and not entry.opt.repeats:
            if len(set(value)) > 1:
                faults.append(Fault(entry.flag, "given once", " and ".join(value)))
            given[entry.key] = value[-1]
    config = given.pop("config", None)
    if config is not None:
        given = {**_from_config(Path(config), entries, faults), **given}
    made = []
    for table in tables:
        called = {entry.key: entry.flag for entry in table.entries()}
        with collect_faults(faults):
            made.append(table.read({key: given[key] for key in called if key in given}, "", called))
    raise_all(faults)
    return made


def _from_config(path: Path, entries: Sequence[Entry], faults: list[Fault]) -> dict[str, Any]:
    """Return the values of a TOML file by key; relative paths start at its folder."""
    options = {name: entry for entry in entries for name in (entry.key, entry.name)}
    values = {}
    for name, value in read_toml(path).items():
        entry = options.get(name.replace("-", "_"))
        if entry is None:
            faults.append(unknown(name, list(options), str(path)))
        else:
            values[entry.key] = under(path.parent, value) if entry.kind.is_path else value
    return values


def _parser(prog: str, text: str, entries: Sequence[Entry], epilog: str) -> argparse.ArgumentParser:
    from stapeskit import __version__

    parser = argparse.ArgumentParser(
        prog=prog,
        description=text,
        epilog=epilog,
        allow_abbrev=False,
        exit_on_error=False,
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, 2, 26, 80),
    )
    parser.add_argument("--version", action="version", version=f"{prog} {__version__}")
    help_text = "options from a TOML file; the command line wins"
    parser.add_argument("--config", metavar="FILE.toml", default=argparse.SUPPRESS, help=help_text)
    groups: dict[str, Any] = {"": parser}
    for entry in entries:
        group = entry.opt.group
        if group not in groups:
            groups[group] = parser.add_argument_group(group)
        more: dict[str, Any] = {"help": entry.opt.help.replace("%", "%%"), "default": argparse.SUPPRESS}
        if entry.opt.positional:
            nargs = "*" if entry.opt.repeats else "?"
            parser.add_argument(entry.key, nargs=nargs, metavar=entry.name.upper(), **more)
        elif entry.is_flag:
            groups[group].add_argument(entry.flag, dest=entry.key, action="store_true", **more)
        else:
            more |= {"metavar": entry.kind.metavar, "action": "append", "dest": entry.key}
            groups[group].add_argument(entry.flag, **more)
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
