"""Apply what the user states where files are silent: bodies, runs, beams, averages, units."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from kinematics.readers.points import Points
from kinematics.readers.recording import Recording, Row
from kinematics.readers.units import LENGTHS, MotionUnit
from stapeskit.arrays import Array
from stapeskit.faults import Fault, Place, StapeskitError, list_some, raise_all
from stapeskit.frames import axis_vector
from stapeskit.warnings import Notice

DEFAULT_BODY = "body"
"""Name of the body of files that name none and of which nothing else says more."""

DEFAULT_RUN = "1"

_SPAN = re.compile(r"(\d{1,9})\s*-\s*(\d{1,9})")


@dataclass(frozen=True)
class FileFacts:
    """What the user states where files are silent: options of ``points2dof``, by their names.

    See `kinematics.options.MotionOptions`; empty or None where nothing is stated.
    """

    body: tuple[str, ...] = ()
    run: tuple[str, ...] = ()
    beam: str = ""
    amplitude: str | None = ""
    length_unit: str | None = ""
    n_avg: float | None = None
    channels: Path | None = None
    averages: int = 30
    period_s: float | None = None

    @cached_property
    def bodies(self) -> tuple[tuple[str, tuple[tuple[str, str], ...]], ...]:
        """The rules of ``body``: a name, and pairs of file and points; refused where one cannot be read."""
        return tuple(_rule(text) for text in self.body)

    @cached_property
    def runs(self) -> dict[str, str]:
        """Names of runs by the files of ``run``."""
        rules = (text.partition("=") for text in self.run)
        return {file.strip(): name.strip() for name, _, file in rules}

    def unused(self, recordings: Iterable[Recording]) -> list[Fault]:
        """List the options that were given but that no file needs."""
        needed = frozenset[str]().union(*(one.lacks for one in recordings))
        want, step = "left out where the files say it, or need none", "Leave it out, or correct the file"
        return [
            Fault(f"--{name.replace('_', '-')}", want, "a value", "", step)
            for name in ("beam", "amplitude", "length_unit", "n_avg")
            if getattr(self, name) and name not in needed
        ]


def with_facts(
    rows: Sequence[Row], found: Recording, facts: FileFacts
) -> tuple[list[Row], frozenset[str], list[Notice]]:
    """Return the rows with what is stated, what their file does not say, and what is assumed in its place."""
    silent = {
        "beam": any(np.any(np.isnan(row.direction)) for row in rows),
        "amplitude": any(_may_be_rms(row) for row in rows),
        "length_unit": not found.length_stated,
        "n_avg": all(row.n_avg is None and row.sd is None for row in rows),
    }
    lacks, notices = frozenset(name for name, lacking in silent.items() if lacking), list[Notice]()
    places = np.array([row.position_m for row in rows if not np.any(np.isnan(row.position_m))])
    if "length_unit" in lacks and len(places) and not facts.length_unit:
        extent = " x ".join(f"{1e3 * span:.4g}" for span in np.ptp(places, axis=0))
        text = (
            f"{found.file} does not say the unit of its positions: taken as metres they extend over {extent} "
            "mm. State --length-unit m, mm or um."
        )
        notices.append(Notice("length_unit_assumed", text))
    if "amplitude" in lacks and not facts.amplitude:
        text = f"{found.file} does not say whether amplitudes are peak or rms: they were taken as peak."
        notices.append(Notice("amplitude_assumed", text))
    length = LENGTHS[facts.length_unit] if facts.length_unit and "length_unit" in lacks else 1.0
    changed = []
    for row in rows:
        stated: dict[str, Any] = {"position_m": row.position_m * length}
        if facts.beam and np.any(np.isnan(row.direction)):
            stated["direction"] = direction_of(facts.beam)
        if facts.amplitude == "rms" and _may_be_rms(row):
            stated["value"] = row.value * np.sqrt(2.0)
            stated["sd"] = None if row.sd is None else row.sd * np.sqrt(2.0)
        if facts.n_avg is not None and "n_avg" in lacks:
            stated["n_avg"] = np.full(row.value.shape, float(facts.n_avg))
        changed.append(replace(row, **stated))
    return changed, lacks, notices


def _may_be_rms(row: Row) -> bool:
    """Return whether nothing says if values are peak or rms, which for a response is one."""
    return isinstance(row.unit, MotionUnit) and not row.unit.per and not row.unit.amplitude


def _rule(text: str) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Read ``NAME=POINTS``; a file before a colon is that of the points that follow."""
    name, _, points = (part.strip() for part in text.partition("="))
    chosen, file = list[tuple[str, str]](), ""
    for part in points.split(","):
        head, colon, item = (text.strip() for text in part.rpartition(":"))
        file = head if colon else file
        chosen.append((file, item))
    spans = [span for _, item in chosen if (span := _SPAN.fullmatch(item))]
    if not name or not all(item for _, item in chosen) or any(int(span[1]) > int(span[2]) for span in spans):
        step = "Write it like --body stapes=1-10,12 or --body base=base.uff"
        raise StapeskitError.of("--body", "NAME= and numbers, ranges or names", text, "", step)
    return name, tuple(chosen)


def _means(file: str, item: str, row: Row) -> bool:
    """Return whether a row is meant; a name without a file may be that of a file."""
    if file and not is_file(file, row.file):
        return False
    if span := _SPAN.fullmatch(item):
        return row.point.isdecimal() and int(span[1]) <= int(row.point) <= int(span[2])
    return row.point == item or (not file and not item.isdigit() and is_file(item, row.file))


def is_file(item: str, file: str) -> bool:
    """Return whether a file is named by its name, with or without the ending."""
    return item in (file, file.rsplit(".", 1)[0])


def direction_of(text: str, where: Place | str = "", thing: str = "--beam") -> Array:
    """Read ``-z`` or ``0,0.34,0.94`` as a unit vector (3,).

    Raises
    ------
    StapeskitError
        Neither a name of an axis nor three numbers that are not all zero.
    """
    axis = axis_vector(text.strip())
    if axis is not None:
        return axis
    try:
        numbers = np.array([float(part) for part in text.split(",")])
        length = float(np.linalg.norm(numbers))
    except ValueError:
        numbers, length = np.zeros(0), 0.0
    if numbers.shape != (3,) or not 0.0 < length < np.inf:
        raise StapeskitError.of(thing, "x, -y ... or three numbers X,Y,Z", text, where)
    return np.asarray(numbers / length)


def with_bodies(
    rows: Sequence[Row], points: Points | None, facts: FileFacts
) -> tuple[list[Row], list[Notice]]:
    """Give every row its body: by ``--body``, its file or the points file; one body needs none.

    Raises
    ------
    StapeskitError
        Points of no body, of several, or missing in the points file; a part of a rule that means no point.
    """
    faults, assigned, respelled = list[Fault](), list[Row](), list[str]()
    bare, unlisted = defaultdict[str, list[str]](list), defaultdict[str, list[str]](list)
    several = points is not None or bool(facts.body) or any(row.body for row in rows)
    for row in rows:
        ruled = [name for name, items in facts.bodies if any(_means(*item, row) for item in items)]
        names = list(dict.fromkeys([*ruled, *filter(None, [row.body])]))
        if not names and points is not None:
            names = points.bodies_of(row.point)
        if not names and several:
            bare[row.file].append(row.point)
            continue
        if len(names) > 1:
            step, got = "Name each point once, by file: --body base=base.uff:1-9", " and ".join(names)
            faults.append(Fault(f"point {row.point}", "of one body", got, row.where, step))
        key = ([*names, DEFAULT_BODY][0], row.point)
        found = key if points is None else points.key_of(*key)
        if found is None and (row.body or np.any(np.isnan(row.position_m))):
            unlisted[key[0]].append(row.point)
        elif found not in (key, None):
            respelled.append(f"{' '.join(key)} as {' '.join(found)}")
        body, point = found or key
        assigned.append(replace(row, body=body, point=point))
    for body, missing in unlisted.items():
        thing, step = f"points {list_some(missing, 8)} of body {body}", "Add them to it"
        faults.append(Fault(thing, "listed in the points file", "no rows of these names", "", step))
    for file, missing in bare.items():
        step = "Name them with --body, e.g. --body stapes=1-10 --body base=11-19, or list them in --points"
        faults.append(Fault(f"points {list_some(missing, 12)}", "of a body", "none", file, step))
    known = [list_some((getattr(row, name) for row in rows), 20) for name in ("point", "file")]
    for name, items in facts.bodies:
        unmet = [item for item in items if not any(_means(*item, row) for row in rows)]
        if unmet:
            got = ", ".join(":".join(filter(None, item)) for item in unmet)
            want = f"points or files that were measured ({'; '.join(known)})"
            faults.append(Fault(f"--body {name}", want, got, "", "Correct the names"))
    raise_all(faults)
    text = f"names were read as {points and points.file} spells them: {list_some(respelled, 3)}."
    return assigned, [Notice("file_read", text)] if respelled else []


def with_runs(rows: Sequence[Row], facts: FileFacts) -> tuple[list[Row], list[Notice]]:
    """Give every row its run: by ``--run``, by its file's content, else by what the files share.

    Files without names of runs that measure one point in one direction again are different excitations, each
    named after its file; files of different points are parts of one.

    Raises
    ------
    StapeskitError
        A rule names no file.
    """
    given = list(dict.fromkeys(row.file for row in rows))
    raise_all(
        Fault(f"the file of --run {name}={file}", f"one of {', '.join(given)}", file, "", "Correct its name")
        for file, name in facts.runs.items()
        if not any(is_file(file, other) for other in given)
    )
    stated = {one: name for one in given for file, name in facts.runs.items() if is_file(file, one)}
    labelled = [replace(row, run=f"{stated.get(row.file, '')} {row.run}".strip()) for row in rows]
    files = defaultdict[object, set[str]](set)
    for row in labelled:
        files[row.key].add(row.file)
    if all(len(names) == 1 for names in files.values()):
        return [replace(row, run=row.run or DEFAULT_RUN) for row in labelled], []
    named = [
        row if facts.runs and row.run else replace(row, run=f"{Path(row.file).stem} {row.run}".strip())
        for row in labelled
    ]
    listed = list_some((row.run for row in named), 6)
    text = f"the files measure the same points again: they are different runs, {listed}. --run names them."
    return named, [Notice("file_read", text)]
