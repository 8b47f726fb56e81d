"""The study that the page edits: a file of ``scan2kd``, written whole after every change."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ct_inertia.options import MassOptions
from fitting.options import KDOptions
from kinematics.options import MotionOptions
from pipeline.study import About
from stapeskit.faults import Fault, StapeskitError
from stapeskit.options import Options, read_toml, toml

HEAD = "# Written by stapeskit app after every change; comments are not kept."
SEARCH = ("threshold", "seed_mm", "box_mm")
"""Keys of [scan] that the stapes is sought by; labels take their place."""

TABLES: dict[str, type[Options]] = {
    "study": About,
    "scan": MassOptions,
    "ldv": MotionOptions,
    "fit": KDOptions,
}


@dataclass(frozen=True)
class Places:
    """The files of a study: hand work next to it, results in folders.

    Attributes
    ----------
    study : Path
        The study file, NAME.toml.
    """

    study: Path

    def beside(self, ending: str) -> Path:
        """Return NAME with an ending, in the folder of the study."""
        return self.study.with_name(self.study.stem + ending)

    @property
    def found(self) -> Path:
        """Folder of the mass as found without hand work."""
        return self.beside("_app") / "found"

    @property
    def cut(self) -> Path:
        """Folder of the mass with the labels that were drawn."""
        return self.beside("_app") / "cut"

    @property
    def points(self) -> Path:
        """What was found of the measurement, for the page."""
        return self.beside("_app") / "points.json"

    @property
    def fit(self) -> Path:
        """What was fitted, for the page."""
        return self.beside("_app") / "fit.json"

    @property
    def out(self) -> Path:
        """Folder of ``scan2kd NAME.toml``."""
        return self.beside("_out")

    def unused(self, ending: str) -> Path:
        """Return NAME with an ending, numbered where a file of that name exists."""
        path, number = self.beside(ending), 1
        while path.exists():
            number += 1
            stem, suffix = ending.split(".", 1)
            path = self.beside(f"{stem}_{number}.{suffix}")
        return path


@dataclass
class StudyFile:
    """Tables of a study in memory and on disk.

    Attributes
    ----------
    path : Path
    tables : dict of str to dict
        As in the file: study, scan, ldv, fit.
    """

    path: Path
    tables: dict[str, dict[str, Any]] = field(default_factory=dict)
    _seen: tuple[int, int] | None = None  # what tells that the file on disk is as this page left it

    @classmethod
    def read(cls, path: Path) -> StudyFile:
        """Open a study; one that the app did not write is continued in NAME_app.toml.

        Raises
        ------
        StapeskitError
            The file is missing or no TOML, or holds something else than tables.
        """
        path = Path(path).absolute()
        content = read_toml(path)
        for name, value in content.items():
            if not isinstance(value, Mapping):
                raise StapeskitError.of(
                    f"the entry {name}", "in one of the tables of a study", value, path.name
                )
        tables = {name: dict(value) for name, value in content.items()}
        if _is_ours(path):
            return cls(path, tables, stamp(path))
        own = path.with_name(f"{path.stem}_app.toml")
        if own.exists():
            step = f"Open {own.name}, or move it away"
            raise StapeskitError.of(
                f"the study {path.name}", "one that the app has not continued yet", own.name, "", step
            )
        tables.setdefault("study", {}).setdefault("name", path.stem)
        return cls(own, tables)

    @classmethod
    def new(cls, folder: Path, name: str) -> StudyFile:
        """Begin a study of a name; its file is written with the first change.

        Raises
        ------
        StapeskitError
            The name cannot be that of a file, or there is a study of that name.
        """
        name = name.strip()
        if not name or name.startswith(".") or set(name) & set('/\\:*?"<>|') or not name.isprintable():
            step = "Write for example ear1"
            raise StapeskitError.of("the name", "one that a file can have", name or "nothing", "", step)
        path = Path(folder).absolute() / f"{name}.toml"
        if path.exists():
            step = "Open it, or choose another name"
            raise StapeskitError.of("the name", "that of no study in this folder", path.name, "", step)
        return cls(path, {"study": {"name": name}})

    @property
    def places(self) -> Places:
        """Where results and hand work are."""
        return Places(self.path)

    def get(self, table: str, key: str) -> Any:
        """Return a value, None where there is none."""
        return self.tables.get(table, {}).get(key)

    def file(self, table: str, key: str) -> Path | None:
        """Return the path that a key names."""
        value = self.get(table, key)
        return None if not value or value == "none" else self.path.parent / str(value)

    def put(self, table: str, **values: Any) -> None:
        """Set keys of a table and save; None, an empty text or list removes a key. Paths become relative.

        Raises
        ------
        StapeskitError
            A value is not what it must be, or the file was changed elsewhere; nothing is changed then.
        """
        new = {**self.tables.get(table, {})}
        for key, value in values.items():
            if value is None or value in ("", [], ()):
                new.pop(key, None)
            else:
                new[key] = self.relative(value) if isinstance(value, Path) else value
        if new == self.tables.get(table, {}) and self.path.exists():
            return
        TABLES[table].from_study(new, self.path.name, self.path.parent)
        self.save({**self.tables, table: new})

    def relative(self, path: Path) -> str:
        """Return a path as the study names it."""
        path, folder = Path(path).absolute(), self.path.parent
        inside = path.is_relative_to(folder)
        return path.relative_to(folder).as_posix() if inside else path.as_posix()

    def save(self, tables: Mapping[str, dict[str, Any]]) -> None:
        """Write the study at once and keep its tables.

        Raises
        ------
        StapeskitError
            The file is not as this page left it: another tab, or an editor, has changed it.
        """
        check_unchanged(self.path, self._seen)
        order = [*TABLES, *(name for name in tables if name not in TABLES)]
        text = [HEAD]
        for name in order:
            if tables.get(name):
                text += ["", f"[{name}]", *(f"{key} = {toml(value)}" for key, value in tables[name].items())]
        replace_file(self.path, "\n".join(text) + "\n")
        self.tables, self._seen = dict(tables), stamp(self.path)

    def put_labels(self, path: Path | None) -> None:
        """Name the labels that were drawn, or none.

        Labels say where the stapes is, and exclude what it is sought by: that is kept in NAME_app/search.json
        meanwhile.
        """
        search = {key: self.get("scan", key) for key in SEARCH if self.get("scan", key) is not None}
        if path is None:
            self.put("scan", labels=None, **self._search())
            return
        if search:
            replace_file(self._search_file, json.dumps(search))
        self.put("scan", labels=path, **dict.fromkeys(SEARCH))

    @property
    def _search_file(self) -> Path:
        return self.places.beside("_app") / "search.json"

    def _search(self) -> dict[str, Any]:
        """Return what the stapes was sought by before labels were drawn."""
        if not self._search_file.is_file():
            return {}
        kept = json.loads(self._search_file.read_text(encoding="utf-8"))
        return {key: kept[key] for key in SEARCH if key in kept}

    def mass_options(self, *, hand_work: bool) -> MassOptions:
        """Return the options of ct2mass; without hand work the labels that were drawn here are left out.

        Raises
        ------
        StapeskitError
            What is wrong with the table, or both tables that may name the side contradict each other.
        """
        values = dict(self.tables.get("scan", {}))
        if not hand_work and self.labels_are_ours:
            values.pop("labels", None)
            values |= self._search()
        side = self.get("study", "side")
        if side and values.get("side", side) != side:
            got = f"{side} in [study] and {values['side']} in [scan]"
            raise StapeskitError.of("the side of the ear", "stated once or alike", got, self.path.name)
        values |= {"side": side} if side else {}
        return MassOptions.from_study(values, self.path.name, self.path.parent)

    @property
    def labels_are_ours(self) -> bool:
        """Whether the labels of the study were drawn in the app, by their name."""
        return str(self.get("scan", "labels") or "").startswith(f"{self.path.stem}_labels")


def check_unchanged(path: Path, seen: tuple[int, int] | None) -> None:
    """Refuse to write over a file that somebody else has changed since it was read or written here.

    Raises
    ------
    StapeskitError
        It has changed, or appeared.
    """
    if path.exists() and stamp(path) != seen:
        step = "Open the study again: what is there is kept"
        fault = Fault(path.name, "as this page left it", "changed in another tab or program", "", step)
        raise StapeskitError(fault)


def replace_file(path: Path, content: str | bytes) -> None:
    """Write a file so that it is there whole or as it was."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.new")
    draft.write_bytes(content.encode() if isinstance(content, str) else content)
    os.replace(draft, path)


def stamp(path: Path) -> tuple[int, int] | None:
    """Return what tells whether a file has changed: its time and size; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


def _is_ours(path: Path) -> bool:
    return path.read_text(encoding="utf-8", errors="replace").startswith(HEAD)
