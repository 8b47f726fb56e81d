"""The study that the page edits: a file of ``scan2kd``, saved after every change, its comments kept."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit

from ct_inertia.options import MassOptions
from pipeline.study import TABLES
from stapeskit.documents import read_json
from stapeskit.faults import StapeskitError
from stapeskit.options import read_toml

SEARCH = ("labels", "threshold", "seed_mm", "box_mm")
"""Keys of [scan] that the stapes is sought by; labels that are drawn take their place."""


@dataclass
class StudyFile:
    """A study in memory and on disk; everything else of it that the page keeps is in NAME_app/.

    Attributes
    ----------
    path : Path
        The study file, NAME.toml.
    text : str
        Its content as it is here.
    seen : tuple or None
        The `stamp` of the file when it was last read or written here.
    """

    path: Path
    text: str
    seen: tuple[int, int] | None = None

    @classmethod
    def read(cls, path: Path) -> StudyFile:
        """Open a study.

        Raises
        ------
        StapeskitError
            The file is missing or no TOML, or holds something else than tables.
        """
        path = Path(path).absolute()
        for name, value in read_toml(path).items():
            if not isinstance(value, Mapping):
                raise StapeskitError.of(f"the entry {name}", "in a table of a study", value, path.name)
        seen = stamp(path)
        return cls(path, path.read_text(encoding="utf-8-sig"), seen)

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
        study = cls(path, "")
        study.text = study.changed("study", name=name)
        return study

    @property
    def tables(self) -> dict[str, dict[str, Any]]:
        """The tables of the study: study, scan, ldv, fit."""
        return tomlkit.parse(self.text).unwrap()

    @property
    def kept(self) -> Path:
        """Folder of what the page keeps: hand work, and what its steps found."""
        return self.path.with_name(f"{self.path.stem}_app")

    @property
    def found(self) -> Path:
        """Folder of the mass as found without hand work."""
        return self.kept / "found"

    @property
    def cut(self) -> Path:
        """Folder of the mass with the labels that were drawn."""
        return self.kept / "cut"

    @property
    def out(self) -> Path:
        """Folder of ``scan2kd NAME.toml``."""
        return self.path.with_name(f"{self.path.stem}_out")

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
            if value is None or value in ("", [], ()):
                own.pop(key, None)
            elif own.get(key) != value:
                own[key] = self._relative(value) if isinstance(value, Path) else value
        if not own:
            document.pop(table)
        return tomlkit.dumps(document)

    def put(self, table: str, **values: Any) -> None:
        """Set keys of a table and save.

        Raises
        ------
        StapeskitError
            A value is not what it must be, or the file was changed elsewhere; nothing is changed then.
        """
        new = StudyFile(self.path, self.changed(table, **values))
        TABLES[table].from_study(new.tables.get(table, {}), self.path.name, self.path.parent)
        if new.text != self.text or not self.path.exists():
            self.save(new.text)

    def save(self, text: str) -> None:
        """Write the study.

        Raises
        ------
        StapeskitError
            Another tab, or an editor, has changed the file since it was read or written here.
        """
        self.seen = replace_file(self.path, text, self.seen)
        self.text = text

    def _relative(self, path: Path) -> str:
        path, folder = Path(path).absolute(), self.path.parent
        inside = path.is_relative_to(folder)
        return path.relative_to(folder).as_posix() if inside else path.as_posix()

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
        """Return the options of ct2mass; without hand work the labels that were drawn here are left out.

        Raises
        ------
        StapeskitError
            What is wrong with the table, or both tables that may name the side contradict each other.
        """
        tables = self.tables
        values = dict(tables.get("scan", {}))
        if not hand_work and self.labels_are_ours:
            values |= self._search()
        side = tables.get("study", {}).get("side")
        if side and values.get("side", side) != side:
            got = f"{side} in [study] and {values['side']} in [scan]"
            raise StapeskitError.of("the side of the ear", "stated once or alike", got, self.path.name)
        values = {
            key: value for key, value in {**values, **({"side": side} if side else {})}.items() if value
        }
        return MassOptions.from_study(values, self.path.name, self.path.parent)


def replace_file(path: Path, content: str, seen: tuple[int, int] | None) -> tuple[int, int] | None:
    """Write a file so that it is there whole or as it was, and return its `stamp`.

    Raises
    ------
    StapeskitError
        It is not as it was seen last.
    """
    check_unchanged(path, seen)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.new")
    draft.write_text(content, encoding="utf-8")
    os.replace(draft, path)
    return stamp(path)


def check_unchanged(path: Path, seen: tuple[int, int] | None) -> None:
    """Refuse to write over a file that somebody else has changed since it was read or written here.

    Raises
    ------
    StapeskitError
        It has changed, or appeared.
    """
    if path.exists() and stamp(path) != seen:
        step = "Open the study again: what is there is kept"
        got = "changed in another tab or program"
        raise StapeskitError.of(path.name, "as this page left it", got, "", step)


def stamp(path: Path) -> tuple[int, int] | None:
    """Return modification time and size of a file, to see whether it changed; None without a file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
