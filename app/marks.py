"""Points that are set by clicking: landmarks, marks of the plate, and where the stapes is to be sought."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from app.study_file import OwnFile, StudyFile
from ct_inertia.frames.anatomy import LANDMARK_NAMES
from stapeskit.faults import StapeskitError
from stapeskit.tables import read_table

FILES = {"landmarks": 1, "plate_fiducials": 3}
"""Keys of [scan] that name a file of marks, and from how many on: fewer than 3 define no plate frame."""
SEARCH = {"seed_mm": ("in the stapes",), "box_mm": ("a corner of a box", "the opposite corner")}
"""Keys of [scan] that hold marks themselves, and their names."""

Point = tuple[float, float, float]
_SCAN, _PLATE = ("x_mm", "y_mm", "z_mm"), ("x_ref_mm", "y_ref_mm", "z_ref_mm")


class Marks:
    """Marks of a study in scan coordinates, mm, saved at every change.

    Raises
    ------
    StapeskitError
        A file of landmarks, fiducials or marks is at fault.
    """

    def __init__(self, study: StudyFile) -> None:
        self.study = study
        self._own = {key: OwnFile(study.kept / f"{key}.csv") for key in FILES}
        self.points: dict[str, dict[str, Point]] = {key: self._read(key) for key in FILES}  # by key of [scan]
        for key, names in SEARCH.items():
            places = np.reshape(study.get("scan", key) or [], (-1, 3))
            self.points[key] = {name: _point(at) for name, at in zip(names, places, strict=False)}
        self.use_fiducials()

    def _read(self, key: str) -> dict[str, Point]:
        from ct_inertia.frames.fiducials import read_plate_fiducials
        from ct_inertia.frames.landmarks import read_landmarks

        named, own = self.study.file("scan", key), self._own[key].path
        if named is not None and named != own:
            if key == "landmarks":
                return {name: _point(at) for name, at in read_landmarks(named).items()}
            given = read_plate_fiducials(named)
            return {name: _point(at) for name, at in zip(given.names, given.scan_mm, strict=True)}
        if not own.is_file():
            return {}
        table = read_table(own, lambda _header, _file: ({*_SCAN}, {"name"}))  # it may hold none
        names = [table.texts["name"].names[code] for code in table.texts["name"].codes]
        places = zip(*(table.numbers[axis] for axis in _SCAN), strict=True)
        used = named is not None or len(names) < FILES[key]
        return {name: _point(at) for name, at in zip(names, places, strict=True) if used}

    def use_fiducials(self) -> None:
        """Take the names of plate marks, and their places in the plate frame, mm, from the fiducials."""
        from kinematics.place.fiducials import read_fiducials

        path = self.study.file("ldv", "fiducials")
        self.references: dict[str, Point] = {}
        if path is not None:
            known = read_fiducials(path)
            every = zip(known.names, known.reference_mm, strict=True)
            self.references = {name: _point(at) for name, at in every} if known.frame == "plate" else {}

    @property
    def names(self) -> list[str]:
        """Every mark that can be set."""
        return [*LANDMARK_NAMES, *(name for own in SEARCH.values() for name in own), *self.references]

    @property
    def placed(self) -> dict[str, Point]:
        """Every mark that is set."""
        return {name: place for own in self.points.values() for name, place in own.items()}

    def put(self, name: str, scan_mm: Sequence[float] | None) -> None:
        """Set a mark, or remove it (None), and save."""
        self.study.put("scan")  # refused where there is no scan yet
        other = "landmarks" if name in LANDMARK_NAMES else "plate_fiducials"
        key = next((key for key, names in SEARCH.items() if name in names), other)
        points = {known: place for known, place in self.points[key].items() if known != name}
        if scan_mm is not None:
            points[name] = _point(scan_mm)
        value: Path | list[float] | None = None
        if key in FILES:
            self._write(key, points)
            value = self._own[key].path if len(points) >= FILES[key] else None
        elif self.study.labels_are_ours:
            raise StapeskitError("Go back to the cut as found first: labels say where the stapes is.")
        elif len(points) == len(SEARCH[key]):
            value = np.sort(list(points.values()), axis=0).ravel().tolist()
        self.study.put("scan", **{key: value})
        self.points[key] = points

    def _write(self, key: str, points: dict[str, Point]) -> None:
        stated = key == "plate_fiducials" and all(name in self.references for name in points)
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["name", *_SCAN, *(_PLATE if stated else ())])
        for name, place in points.items():
            table.writerow([name, *place, *(self.references[name] if stated else ())])
        self._own[key].write(text.getvalue())
        if not points:
            self._own[key].remove()


def _point(place: Iterable[float]) -> Point:
    x, y, z = (round(float(value), 4) for value in place)
    return x, y, z
