"""The kinds of value that options have: how each is read, what it must be, how it is written.

A kind reads what a command line gives (text), what a TOML file gives and its own values, so that the three
edges share one check.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from legacy.stapeskit.option_values import (
    DOF_NAMES,
    advise_range,
    command_word,
    is_known,
    plain_number,
    read_beam,
    read_bounds,
    read_box,
    read_channels,
    read_covariates,
    read_direction,
    read_dof,
    read_flag,
    read_masses,
    read_measured,
    read_named,
    read_number,
    read_numbers,
    read_path,
    read_paths,
    read_range,
    read_ranges,
    read_spacing,
    read_text,
    read_voxels,
    read_whole,
    read_with_sd,
    read_words,
    read_zero_or_with_sd,
    require,
)


@dataclass(frozen=True)
class Kind:
    """One kind of value.

    Attributes
    ----------
    expected : str
        What the value must be, as in "<option> must be ...".
    metavar : str
        Placeholder of the value in the help.
    read : callable
        Takes text, a TOML value or a value of the kind, returns the value; ValueError when it is unfit.
    is_flag, is_file : bool
        Whether the option takes no value; whether the value is the path of a file or folder that is read.
    repeats : bool
        Whether the option may be given several times; ``read`` then takes the list of what was given.
    choices : tuple of str
        The values that are known, where they can be listed.
    advise : callable, optional
        Takes an unfit value, returns what a user can do about it.
    """

    expected: str
    metavar: str
    read: Callable[[Any], Any]
    is_flag: bool = False
    is_file: bool = False
    repeats: bool = False
    choices: tuple[str, ...] = ()
    advise: Callable[[Any], str] | None = None

    def words(self, value: Any) -> list[str]:
        """Write a value as on the command line: one text, or one for each time the option is given."""
        if self.repeats:
            entries = (
                [f"{name}={entry!r}" for name, entry in value.items()]
                if isinstance(value, Mapping)
                else value
            )
            return [command_word(entry) for entry in entries]
        return [command_word(value)]


FLAG = Kind("true or false", "", read_flag, is_flag=True)
TEXT = Kind("text", "TEXT", read_text)
NUMBER = Kind("a number", "NUMBER", read_number)
VALUE_WITH_SD = Kind(
    "a positive number without its unit, or with its standard deviation behind it, VALUE+-SD",
    "VALUE[+-SD]",
    read_with_sd,
)
VALUE_OR_ZERO_WITH_SD = Kind(
    "0, a positive number without its unit, or with its standard deviation behind it, VALUE+-SD",
    "VALUE[+-SD]",
    read_zero_or_with_sd,
)
SPACING = Kind("a positive number, or three of them (x, y, z), mm", "H|DX,DY,DZ", read_spacing)
BOX = Kind(
    "six numbers x0, y0, z0, x1, y1, z1 in mm with x0 < x1, y0 < y1, z0 < z1",
    "X0,Y0,Z0,X1,Y1,Z1",
    read_box,
    advise=lambda _: "Give the lower corner first, then the upper one",
)
POINT = Kind("three numbers x, y, z", "X,Y,Z", lambda value: read_numbers(value, (3,)))
DIRECTION = Kind("three numbers x, y, z that are not all zero", "X,Y,Z", read_direction)
BEAM = Kind(
    "x, y, z, -x, -y, -z or three numbers of length 1 (within 1e-3)",
    "DIR",
    read_beam,
    advise=lambda _: "It points from the sample towards the laser head",
)
VOXELS = Kind(
    "three whole numbers of at least 2: voxels along x (runs fastest), y, z", "NX,NY,NZ", read_voxels
)
RANGE = Kind("two frequencies in Hz, the lower first", "F1,F2", read_range, advise=advise_range)
RANGES = Kind(
    "a range of two frequencies in Hz, the lower first",
    "F1-F2",
    read_ranges,
    repeats=True,
    advise=advise_range,
)
MASSES = Kind(
    "a list of point masses [x, y, z, mg] or [x, y, z, mg, sd], mm and mg, the mass positive",
    "X,Y,Z,MG[+-SD]",
    read_masses,
    repeats=True,
)
LENGTHS = Kind(
    "a list of lengths [x0, y0, z0, x1, y1, z1, length, sd], mm, length and sd positive",
    "X0,Y0,Z0,X1,Y1,Z1,LENGTH+-SD",
    read_measured(2),
    repeats=True,
)
BALLS = Kind(
    "a list of balls [x, y, z, diameter, sd], mm, diameter and sd positive",
    "X,Y,Z,DIAMETER+-SD",
    read_measured(1),
    repeats=True,
)
BODIES = Kind(
    'NAME=POINTS, or a table like { stapes = "1-10", base = "11-19" }',
    "NAME=POINTS",
    read_named,
    repeats=True,
    advise=lambda _: "Points are numbers, ranges, FILE or FILE:1-10: stapes=1-10,12 or base=base.uff",
)
CHANNELS = Kind(
    'BODY:POINT or BODY:POINT:BEAM, or a list of them like ["stapes:3", "base:7:z"]',
    "BODY:POINT[:BEAM]",
    read_channels,
    repeats=True,
    advise=lambda _: "Write them as in dof.channels.csv: stapes:3, or stapes:3:-z for one beam",
)
RUNS = Kind('NAME=FILE, or a table like { push = "first.uff" }', "NAME=FILE", read_named, repeats=True)
BOUNDS = Kind(
    "an entry and a number in SI as K11=100, or a table like { K11 = 100.0 }",
    "ENTRY=VALUE",
    read_bounds,
    repeats=True,
)
COVARIATES = Kind("a table of numbers and texts, like { storage_days = 3 }", "TABLE", read_covariates)
DOF = Kind(
    f"all, or a list of different names out of {', '.join(DOF_NAMES)}",
    "LIST",
    read_dof,
    advise=lambda _: "Write for example y,alpha,gamma",
)


def file(what: str = "file", next_step: str = "Check its name and folder", metavar: str = "FILE") -> Kind:
    """Return the kind of a file that is read."""
    return Kind(f"an existing {what}", metavar, read_path, is_file=True, advise=lambda _: next_step)


def files(what: str, next_step: str = "Check its name and folder") -> Kind:
    """Return the kind of one or several files that are read."""
    single = file(what, next_step)
    return replace(single, read=read_paths, repeats=True)


def output(suffix: str) -> Kind:
    """Return the kind of a file that is written."""

    def read(value: Any) -> Path:
        path = read_path(value)
        require(path.suffix.lower() == suffix and not is_known(path, Path.is_dir))
        return path

    def advise(value: Any) -> str:
        return f"Write {Path(str(value)).stem or 'result'}{suffix}"

    return Kind(f"a file name that ends with {suffix}", f"FILE{suffix}", read, advise=advise)


def _folder(value: Any) -> Path:
    path = read_path(value)
    require(not is_known(path, Path.exists) or path.is_dir())
    return path


FOLDER = Kind("a folder", "DIR", _folder)


def choice(*known: str) -> Kind:
    """Return the kind of one of several words."""

    def read(value: Any) -> str:
        require(isinstance(value, str) and value in known)
        return str(value)

    return Kind(f"one of {', '.join(known)}", "|".join(known), read, choices=known)


def summaries(table: Mapping[str, Any]) -> str:
    """Return the entries of a table with their summaries, as a help; an entry is a text or has a summary."""
    return "; ".join(f"{name}: {getattr(entry, 'summary', entry)}" for name, entry in table.items())


def several(*known: str) -> Kind:
    """Return the kind of a list of words, or ``all``; the value is in the order of the words known."""

    def read(value: Any) -> tuple[str, ...]:
        names = {word.lower() for word in read_words(value) if word}
        if names == {"all"}:
            return known
        require(names <= set(known) and (bool(names) or not isinstance(value, str)))
        return tuple(name for name in known if name in names)

    return Kind(f"all, or a list out of {', '.join(known)}", "LIST|all", read, choices=known)


def _names(value: Any) -> tuple[str, ...]:
    names = read_words(value)
    require(all(names) and (bool(names) or not isinstance(value, str)))
    return names


NAMES = Kind("names separated by commas", "LIST", _names)


def number(expected: str, fits: Callable[[float], bool], step: str = "") -> Kind:
    """Return the kind of a finite number within limits that the words name."""

    def read(value: Any) -> float:
        result = read_number(plain_number(value))
        require(fits(result))
        return result

    return Kind(expected, "NUMBER", read, advise=lambda _: step)


def whole(expected: str, fits: Callable[[int], bool]) -> Kind:
    """Return the kind of a whole number within limits that the words name."""

    def read(value: Any) -> int:
        result = read_whole(plain_number(value))
        require(fits(result))
        return result

    return Kind(expected, "N", read)


def at_least(least: int) -> Kind:
    """Return the kind of a whole number from a least one on."""
    return whole(f"a whole number, {least} or more", lambda value: value >= least)


VOXEL_TYPE = choice("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")
