"""The study that the page edits, and the files that it keeps: whole, and never over another one's changes."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import tomlkit

from ct_inertia.options import MassOptions
from pipeline.study import TABLES, About, scan_of_ear
from stapeskit.documents import read_json
from stapeskit.faults import Fault, StapeskitError, collect_faults, raise_all
from stapeskit.options import read_toml

SEARCH = ("labels", "threshold", "seed_mm", "box_mm")
"""Keys of [scan] that the stapes is sought by; labels that are drawn take their place."""


class OwnFile:
    """A file that this page writes; `path` is where it is."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seen = _stamp(path)

    def write(self, content: str | Callable[[Path], object]) -> None:
        """Write a text, or what a function writes to a path, so that the file is there whole or as it was.

        A `StapeskitError` where another tab, or a program, has changed it since it was read or written here.
        """
        if self.path.exists() and _stamp(self.path) != self._seen:
            step = "Open the study again: what is there is kept"
            got = "changed in another tab or program"
            raise StapeskitError.of(self.path.name, "as this page left it", got, "", step)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        draft = self.path.with_name(f".{self.path.name}.new")
        draft.write_text(content, encoding="utf-8") if isinstance(content, str) else content(draft)
        os.replace(draft, self.path)
        self._seen = _stamp(self.path)

    def remove(self) -> None:
        """Remove it."""
        self.path.unlink(missing_ok=True)
        self._seen = None


def _stamp(path: Path) -> tuple[int, int] | None:
    """Return modification time and size of a file, to see whether it changed; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


_MAY_BE_MISSING = ("ldv.file", "ldv.points", "ldv.fiducials")  # when a study is opened: others can be chosen


class StudyFile(OwnFile):
    """A study: NAME.toml, saved after every change, its comments kept.

    What is wrong with a value, a name or the file is raised as `StapeskitError`; nothing is changed then.
    """

    def __init__(self, path: Path, text: str = "") -> None:
        super().__init__(path)
        self.text = text  # its content as it is here
        self.out = path.with_name(f"{path.stem}_out")  # of scan2kd NAME.toml
        self.kept = path.with_name(f"{path.stem}_app")  # hand work, and what the steps found:
        self.found = self.kept / "found"  # the mass without hand work,
        self.cut = self.kept / "cut"  # the mass with the labels that were drawn,
        self.points = self.kept / "points" / "dof.html"  # the page of the measurement

    @classmethod
    def read(cls, path: Path) -> StudyFile:
        """Open a study; everything that is wrong with its tables is raised together.

        Files of the measurement may be missing: the page lets others be chosen.
        """
        study = cls(Path(path).absolute())
        for name, value in read_toml(study.path).items():
            if not isinstance(value, Mapping):
                raise StapeskitError.of(f"the entry {name}", "in a table of a study", value, study.path.name)
        study.text = study.path.read_text(encoding="utf-8-sig")
        faults: list[Fault] = []
        for name, kind in TABLES.items():
            with collect_faults(faults):
                if name == "scan" and name in study.tables:
                    study.mass_options(hand_work=False)
                elif name in study.tables:
                    kind.from_study(study.tables[name], study.path.name, study.path.parent)
        raise_all(fault for fault in faults if fault.thing not in _MAY_BE_MISSING)
        return study

    @classmethod
    def new(cls, folder: Path, name: str, text: str = "") -> StudyFile:
        """Begin a study of a name that is free; its file is written with the first change."""
        name = name.strip()
        if not name or name.startswith(".") or set(name) & set('/\\:*?"<>|') or not name.isprintable():
            step = "Write for example ear1"
            raise StapeskitError.of("the name", "one that a file can have", name or "nothing", "", step)
        study = cls(Path(folder).absolute() / f"{name}.toml", text)
        if study.path.exists():
            step = "Open it, or choose another name"
            raise StapeskitError.of("the name", "that of no study in this folder", study.path.name, "", step)
        study.text = study.changed("study", name=name)
        return study

    @property
    def tables(self) -> dict[str, dict[str, Any]]:
        """The tables of the study: study, scan, ldv, fit."""
        return tomlkit.parse(self.text).unwrap()

    @property
    def labels_are_ours(self) -> bool:
        """Whether the labels of the study were drawn in the app: they are in its folder."""
        labels = self.file("scan", "labels")
        return labels is not None and labels.parent == self.kept

    def get(self, table: str, key: str) -> Any:
        """Return a value, None where there is none."""
        return self.tables.get(table, {}).get(key)

    def file(self, table: str, key: str) -> Path | None:
        """Return the path that a key names."""
        value = self.get(table, key)
        return None if not value or value == "none" else self.path.parent / str(value)

    def changed(self, table: str, **values: Any) -> str:
        """Return the text with other values of a table; None, an empty text or list removes a key."""
        document = tomlkit.parse(self.text)
        own = document.setdefault(table, tomlkit.table())
        for key, value in values.items():
            if isinstance(value, Path):
                near = value.absolute().is_relative_to(self.path.parent)
                value = (value.absolute().relative_to(self.path.parent) if near else value).as_posix()
            if value is None or value in ("", [], ()):
                own.pop(key, None)
            elif own.get(key) != value:
                own[key] = value
        if not own:
            document.pop(table)
        return tomlkit.dumps(document)

    def checked(self, table: str, **values: Any) -> str:
        """Return the text with other values of a table, which must be what they must be, as `changed`."""
        text = self.changed(table, **values)
        tables = StudyFile(self.path, text).tables
        if not {"file", "labels"} & tables.get("scan", {}).keys():
            raise StapeskitError("Choose a scan, or open a study, first.")
        TABLES[table].from_study(tables.get(table, {}), self.path.name, self.path.parent)
        return text

    def put(self, table: str, **values: Any) -> None:
        """Set keys of a table and save, if they are what they must be."""
        text = self.checked(table, **values)
        if text != self.text or not self.path.exists():
            self.write(text)
            self.text = text

    def put_labels(self, path: Path | None) -> None:
        """Name the labels that were drawn in place of what the stapes was found by, or that again (None)."""
        self.put("scan", **(self._search() if path is None else {**dict.fromkeys(SEARCH), "labels": path}))

    def _search(self) -> dict[str, Any]:
        """Return what the stapes was found by: the mass as found carries it."""
        used = read_json(self.found / "mass.json", "the mass as found", "Measure again")
        stated = used["provenance"]["parameters"]
        values = {key: stated.get(key) for key in SEARCH}
        return values | ({"labels": Path(values["labels"])} if values["labels"] else {})

    def mass_options(self, *, hand_work: bool) -> MassOptions:
        """Return the options of ct2mass; without hand work the labels that were drawn here are left out."""
        tables, place = self.tables, (self.path.name, self.path.parent)
        values = dict(tables.get("scan", {}))
        if not hand_work and self.labels_are_ours:
            values |= self._search()
        stated = {key: value for key, value in values.items() if value is not None}
        about = About.from_study(tables.get("study", {}), *place)
        return scan_of_ear(about, MassOptions.from_study(stated, *place), self.path.name)
