"""The study file: what one ear's scan, vibrometer table and fit are, checked all at once."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from legacy.ct_inertia.options import MassOptions
from legacy.fitting.options import KDOptions
from legacy.kinematics.options import LdvOptions
from legacy.pipeline.errors import PipelineError
from legacy.stapeskit.faults import Fault, raise_all, translate_fault
from legacy.stapeskit.json_toml import parse_toml
from legacy.stapeskit.option_declaration import option
from legacy.stapeskit.option_kinds import COVARIATES, NUMBER, TEXT, choice, file
from legacy.stapeskit.options import OptionTable, declared, read_table


@dataclass(frozen=True)
class About(OptionTable):
    """``[study]``: what this ear is, and the columns of a cohort."""

    table = "study"
    title = "study"
    error = PipelineError

    name: str = option(TEXT, "name of the ear in reports", "", example="ear 1", recommended=True)
    notes: str = option(
        TEXT,
        "free text at the top of the report",
        "",
        example="incus removed, cochlea closed",
        recommended=True,
    )
    side: str | None = option(
        choice("left", "right"), "left or right ear, a column of the cohort", example="left"
    )
    ear: str = option(TEXT, "identifier of the ear", "", example="TB12-L")
    subject: str = option(TEXT, "identifier of the subject, the same for both ears", "", example="TB12")
    age: float | None = option(NUMBER, "age of the subject, years", example=61)
    sex: str = option(TEXT, "sex of the subject", "", example="f")
    group: str = option(TEXT, "group of the ear in a cohort", "", example="control")
    covariates: Mapping[str, Any] = option(
        COVARIATES, "any further columns of a cohort", {}, example={"storage_days": 3.0}
    )
    truth: Path | None = option(
        file("JSON file", metavar="FILE.json"),
        "true values of a simulated ear (mass_kg, dof, stiffness_si, damping_si), shown in the report",
        example="truth.json",
    )


@dataclass(frozen=True)
class Study:
    """One study file."""

    study: About
    scan: MassOptions
    ldv: LdvOptions
    fit: KDOptions

    def anchored(self) -> Study:
        """Return the same study with absolute paths of its files."""
        return Study(self.study.anchored(), self.scan.anchored(), self.ldv.anchored(), self.fit.anchored())


TABLES: dict[str, type[OptionTable]] = {
    "study": About,
    "scan": MassOptions,
    "ldv": LdvOptions,
    "fit": KDOptions,
}
_NEEDED = ("scan", "ldv")


def read_study(path: Path) -> Study:
    """Read and check a study file.

    Raises
    ------
    PipelineError
        The file is missing or no TOML, a key is unknown (the nearest valid one is named), a value is not what
        it must be, a file that it names does not exist, or choices contradict each other: all in one message.
    """
    path = Path(path)
    if not path.is_file():
        raise PipelineError.of(
            "the study file",
            "an existing TOML file",
            path,
            next_step="scan2kd --template prints one to start from",
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as fault:
        got = f"the byte 0x{fault.object[fault.start]:02x}"
        step = "Save it as UTF-8 in the editor, if it is the study file"
        raise PipelineError.of("the study file", "UTF-8 text", got, path.name, step) from fault
    return parse_study(text, path.absolute().parent, path.name)


def parse_study(text: str, folder: Path, name: str = "study.toml", check_files: bool = True) -> Study:
    """Check the text of a study file; see read_study.

    Parameters
    ----------
    folder : Path
        Where relative paths start.
    name : str
        The file's name in messages.
    check_files : bool
        Whether the files named must exist.
    """
    try:
        tables = parse_toml(text)
    except ValueError as fault:
        step = "Write texts and paths in quotes, numbers with decimal points"
        if "\\" in text:
            step = "Write paths with / instead of \\, or in single quotes"
        raise PipelineError.of("the study file", "valid TOML", fault, name, step) from fault
    faults = [_unknown(key, name) for key in tables if key not in TABLES]
    read: dict[str, Any] = {}
    for key, kind in TABLES.items():
        values = tables.get(key, {})
        if key in _NEEDED and key not in tables:
            step = "scan2kd --template shows a whole study file"
            faults.append(Fault(f"the table [{key}]", "given", "nothing", name, step))
        elif not isinstance(values, dict):
            faults.append(Fault(f"the table [{key}]", "a table of keys", values, name))
        else:
            read[key], wrong = read_table(kind, values, name, folder, TABLES.values(), check_files)
            faults += [translate_fault(fault, words(key)) for fault in wrong]
    raise_all(PipelineError, faults)
    study = Study(**read)
    sides = {study.study.side, study.scan.side} - {None}
    if len(sides) > 1:
        got = f"{study.study.side} in [study] and {study.scan.side} in [scan]"
        raise PipelineError.of("the side of the ear", "stated once or alike", got, name)
    return replace(study, scan=replace(study.scan, side=study.study.side or study.scan.side))


def words(table: str) -> Callable[[str], str]:
    """Return how a study file writes the name of an option of that table; others are looked for after it."""
    places: dict[str, str] = {}
    for options in (TABLES[table], *TABLES.values()):
        for entry in declared(options):
            if entry.table:
                places.setdefault(entry.name, entry.place)
    return lambda name: places.get(name, name)


def _unknown(key: str, name: str) -> Fault:
    """Return the fault of an unknown table, with the nearest, or with the table that has such a key."""
    known = [f"[{table}]" for table in TABLES]
    homes = [
        f"{key} in [{option.table}]"
        for kind in TABLES.values()
        for option in declared(kind)
        if option.key == key
    ]
    near = homes or difflib.get_close_matches(f"[{key}]", known, 1)
    hint = f"Did you mean {near[0]}?" if near else ""
    return Fault("a table", f"one of {', '.join(known)}", f"[{key}]", name, hint)
