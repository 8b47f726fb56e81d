"""The study file: what one ear's scan, measurement and fit are; every fault of it in one message."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from ct_inertia.options import MassOptions
from fitting.options import KDOptions
from kinematics.options import MotionOptions
from stapeskit.faults import Fault, StapeskitError, collect_faults, raise_all
from stapeskit.option_types import Number, Table, Text, Words
from stapeskit.options import Opt, Options, read_toml, template
from stapeskit.warnings import Notice, is_among
from stapeskit.warnings import table as warning_table

TITLE = """A study: one ear, from its scan and its vibrometer file to stiffness and damping.
# Run it with: scan2kd study.toml. Paths are relative to this file; a line that begins with # is not set."""


class About(Options):
    """``[study]``: what this ear is, what the user has checked, and the columns of a cohort."""

    table: ClassVar[str] = "study"

    name: Annotated[Text, Opt("name of the ear in reports", example="ear 1", recommended=True)] = ""
    notes: Annotated[
        Text,
        Opt("free text at the top of the report", example="incus removed, cochlea closed", recommended=True),
    ] = ""
    confirmed: Annotated[
        Words,
        Opt("warnings that you checked: they do not lower the verdict",
            example=["handedness_unconfirmed"]),
    ] = ()  # fmt: skip
    side: Annotated[Literal["left", "right"] | None, Opt("left or right ear", example="left")] = None
    ear: Annotated[Text, Opt("identifier of the ear", example="TB12-L")] = ""
    subject: Annotated[Text, Opt("identifier of the subject, the same for both ears", example="TB12")] = ""
    age: Annotated[Number | None, Opt("age of the subject, years", example=61.0)] = None
    sex: Annotated[Text, Opt("sex of the subject", example="f")] = ""
    group: Annotated[Text, Opt("group of the ear in a cohort", example="control")] = ""
    covariates: Annotated[
        Table | None, Opt("any further columns of a cohort", example={"storage_days": 3.0})
    ] = None

    def of_ear(self) -> dict[str, Any]:
        """Return what is known of the ear, its covariates among the other columns."""
        names = ("side", "ear", "subject", "age", "sex", "group")
        known = {name: getattr(self, name) for name in names}
        return {
            **{name: value for name, value in known.items() if value not in (None, "")},
            **(self.covariates or {}),
        }


TABLES: dict[str, type[Options]] = {
    "study": About,
    "scan": MassOptions,
    "ldv": MotionOptions,
    "fit": KDOptions,
}
_NEEDED = ("scan", "ldv")
_NO_STUDY = "Give a study: stapeskit new writes one for the files of a folder. A scan alone goes to ct2mass"


@dataclass(frozen=True)
class Study:
    """One study file."""

    path: Path  # its folder is where relative paths start
    about: About
    scan: MassOptions
    ldv: MotionOptions
    fit: KDOptions

    @property
    def name(self) -> str:
        """Name of the ear; that of the file where none is given."""
        return self.about.name or self.path.stem

    def inputs(self) -> dict[str, Path]:
        """Return every file that the study reads, by its role."""
        tables = (self.about, self.scan, self.ldv, self.fit)
        found: dict[str, Path] = {"study": self.path}
        for table in tables:
            for entry in table.entries():
                value = getattr(table, entry.key)
                paths = value if isinstance(value, tuple) else (value,)
                role = f"{table.table}.{entry.key}"
                for number, path in enumerate(path for path in paths if isinstance(path, Path)):
                    found[role if not number else f"{role}.{number + 1}"] = path
        return found


def study_template() -> str:
    """Return a study file with every key."""
    return template(TITLE, list(TABLES.values()))


def read_study(path: Path) -> Study:
    """Read and check a study file; files that it names must exist, and nothing of them is read.

    Raises
    ------
    StapeskitError
        The file is missing or no TOML, a key is unknown (the nearest valid one is named), a value is not what
        it must be, or choices contradict each other: all in one message.
    """
    path = Path(path)
    step = "" if path.suffix.lower() == ".toml" else _NO_STUDY
    content, name = read_toml(path, step), path.name
    faults = [_unknown_table(key, name) for key in content if key not in TABLES]
    read: dict[str, Any] = {}
    for key, table in TABLES.items():
        values = content.get(key, {})
        if key in _NEEDED and key not in content:
            step = "scan2kd --template shows a whole study file"
            faults.append(Fault(f"the table [{key}]", "given", "nothing", name, step))
        elif not isinstance(values, Mapping):
            faults.append(Fault(f"the table [{key}]", "a table of keys", values, name))
        else:
            with collect_faults(faults):
                own = _without_other_tables(values, key, name, faults)
                read[key] = table.from_study(own, name, path.absolute().parent)
    faults += _unknown_warnings(read["study"].confirmed, name) if "study" in read else []
    raise_all(faults)
    about = read["study"]
    scan = scan_of_ear(about, read["scan"], name)
    return Study(path.absolute(), about, scan, read["ldv"], read["fit"])


def in_keys(notices: Iterable[Notice], own: type[Options]) -> tuple[Notice, ...]:
    """Replace the flags that warnings name by keys of a study; their ``own`` table comes first."""
    tables = (*TABLES.values(), own)  # the last one that has a flag names it
    keys = {entry.flag: f"{table.table}.{entry.key}" for table in tables for entry in table.entries()}

    def key(flag: re.Match[str]) -> str:
        return keys.get(flag[0], flag[0])

    return tuple(replace(one, text=re.sub(r"--[a-z-]+", key, one.text)) for one in notices)


def scan_of_ear(about: About, scan: MassOptions, file: str) -> MassOptions:
    """Return the options of the scan with the side of the ear, which either table may name.

    Raises
    ------
    StapeskitError
        Both name it, and another one.
    """
    if about.side and scan.side and about.side != scan.side:
        got = f"{about.side} in [study] and {scan.side} in [scan]"
        raise StapeskitError.of("the side of the ear", "stated once or alike", got, file)
    return replace(scan, side=about.side or scan.side)


def _without_other_tables(
    values: Mapping[str, Any], table: str, name: str, faults: list[Fault]
) -> dict[str, Any]:
    """Return the values of a table without keys of other tables, which become faults that name their home."""
    own = set(TABLES[table].key_names())
    kept = dict(values)
    for key in [key for key in values if key not in own]:
        homes = [f"[{home}]" for home, kind in TABLES.items() if key in kind.key_names()]
        if homes:
            step = f"Move it to {' or '.join(homes)}"
            faults.append(Fault(f"{table}.{key}", "a key of this table", "one of another table", name, step))
            del kept[key]
    return kept


def _unknown_warnings(confirmed: Sequence[str], name: str) -> list[Fault]:
    """Return a fault for each confirmed warning that is neither a code nor the first words of one."""
    codes, faults = list(warning_table()), []
    for word in confirmed:
        if not any(is_among(code, [word]) for code in codes):
            near = difflib.get_close_matches(word, codes, 1) or [code for code in codes if word in code]
            step = f"Did you mean {near[0]}?" if near else "docs/warnings.md lists all codes"
            now = next((code for code, entry in warning_table().items() if word in entry.was), "")
            step = f"It is {now} now" if now else step
            faults.append(Fault("study.confirmed", "codes of warnings", word, name, step))
    return faults


def _unknown_table(key: str, name: str) -> Fault:
    known = [f"[{table}]" for table in TABLES]
    homes = [f"{key} in [{table}]" for table, kind in TABLES.items() if key in kind.key_names()]
    near = homes or difflib.get_close_matches(f"[{key}]", known, 1)
    step = f"Did you mean {near[0]}?" if near else ""
    return Fault("a table", f"one of {', '.join(known)}", f"[{key}]", name, step)
