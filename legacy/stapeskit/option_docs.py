"""The template of a study file and the page of options, made from the declarations."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from html import escape

from legacy.stapeskit.option_declaration import Option
from legacy.stapeskit.option_names import written
from legacy.stapeskit.option_values import toml
from legacy.stapeskit.options import OptionTable, declared

# Letters a line of a study file.
_WIDTH = 100
_INTRODUCTION = """\
# Options

Made from `<room>/options.py` by `make docs`; edit those.

A command takes `--name VALUE`, or `name = value` in the file of `--config`; a study file takes the key;
Python takes `name=value` with the same names."""


def template(title: str, tables: Mapping[str, type[OptionTable]]) -> str:
    """Return a commented study file; what is recommended is set, everything else is a comment.

    Parameters
    ----------
    title : str
        The first lines, without their marks.
    tables : mapping
        Tables of options by their names in the file.
    """
    lines = [f"# {line}" for line in title.splitlines()]
    for name, table in tables.items():
        lines += ["", f"[{name}]"]
        group = ""
        for option in _of_study(table):
            if option.group != group:
                group = option.group
                lines += ["", f"## {group}"] if group else []
            lines += [
                f"# {line}"
                for line in textwrap.wrap(_study_help(option, table), _WIDTH, break_on_hyphens=False)
            ]
            mark = "" if option.recommended or option.required else "# "
            lines.append(f"{mark}{option.key} = {toml(example_of(option))}")
    return "\n".join(lines) + "\n"


def example_of(option: Option) -> object:
    """Return a value to show for an option."""
    if option.example is None and option.default is None:
        raise ValueError(f"{option.name} has neither a default nor an example")
    return option.default if option.example is None else option.example


def page(commands: Mapping[str, Iterable[type[OptionTable]]], others: Iterable[type[OptionTable]]) -> str:
    """Return the page of all options in Markdown, a table a command.

    Parameters
    ----------
    commands : mapping
        Tables of options by command.
    others : iterable of type
        Tables that only study files have.
    """
    lines = [_INTRODUCTION]
    for command, tables in commands.items():
        lines += ["", f"## {command}", "", "| option | value | study key | default | what it does |"]
        lines.append("|---|---|---|---|---|")
        lines += [_row(option) for table in tables for option in declared(table)]
    for table in others:
        lines += ["", f"## [{table.table}] of a study file", "", "| key | example | what it is |"]
        lines.append("|---|---|---|")
        lines += [_key_row(option) for option in declared(table)]
    return "\n".join(lines) + "\n"


def _key_row(option: Option) -> str:
    return f"| `{option.key}` | `{toml(example_of(option))}` | {_cell(option.help)} |"


def _row(option: Option) -> str:
    flag = f"`{option.flag}`"
    value = "" if option.kind.is_flag or option.positional else _code(option.metavar)
    key = f"`{option.place}`" if option.table else ""
    usual = option.default in (None, False, "", (), {})
    default = "" if usual else f"`{', '.join(option.kind.words(option.default))}`"
    text = written(option.help, lambda name: "--" + name.replace("_", "-"))
    return f"| {flag} | {value} | {key} | {default} | {_cell(text)} |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _code(text: str) -> str:
    """Return code for a cell of a table, bars as ``&#124;``: a backslash shows within code on websites."""
    return f"<code>{escape(text, quote=False).replace('|', '&#124;')}</code>" if "|" in text else f"`{text}`"


def _of_study(table: type[OptionTable]) -> list[Option]:
    return [option for option in declared(table) if option.table]


def _study_help(option: Option, table: type[OptionTable]) -> str:
    """Return the help of a key; other options of the table by their keys."""
    keys = {other.name: other.key for other in declared(table)}
    return written(option.help, lambda name: keys.get(name, name))
