"""Points that are set by clicking: anatomical landmarks, and the marks of fiducials.csv on the plate."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

from app.study_file import StudyFile, replace_file, stamp
from ct_inertia.frames.anatomy import LANDMARK_NAMES
from stapeskit.tables import read_table

LEAST = {"landmarks": 1, "plate_fiducials": 3}
"""Keys of [scan], and from how many marks on the study names them: fewer than 3 define no plate frame."""

Point = tuple[float, float, float]
_COLUMNS = ("x_mm", "y_mm", "z_mm")


class Marks:
    """Marks of a study in scan coordinates, mm, saved at every change.

    Attributes
    ----------
    points : dict of str to dict of str to (x, y, z)
        Marks by name, by key of [scan].
    references : dict of str to (x, y, z)
        Where the marks of the plate are in the plate frame, by fiducials.csv, mm.

    Raises
    ------
    StapeskitError
        A file of landmarks, fiducials or marks is at fault.
    """

    def __init__(self, study: StudyFile) -> None:
        from ct_inertia.frames.fiducials import read_plate_fiducials
        from ct_inertia.frames.landmarks import read_landmarks

        self.study = study
        self._stamps = {key: stamp(self._own(key)) for key in LEAST}
        self.points: dict[str, dict[str, Point]] = {key: {} for key in LEAST}
        for key, own in self.points.items():
            path = study.file("scan", key) or self._own(key)
            if path == self._own(key):
                kept = _read(path) if path.exists() else {}
                if study.get("scan", key) or len(kept) < LEAST[key]:
                    own.update(kept)
            elif key == "landmarks":
                own.update({name: _point(at) for name, at in read_landmarks(path).items()})
            else:
                given = read_plate_fiducials(path)
                own.update({name: _point(at) for name, at in zip(given.names, given.scan_mm, strict=True)})
        self.use_fiducials()

    def use_fiducials(self) -> None:
        """Take the names of plate marks, and their places on the plate, from the study's fiducials."""
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
        return [*LANDMARK_NAMES, *self.references]

    @property
    def placed(self) -> dict[str, Point]:
        """Every mark that is set."""
        return {name: place for own in self.points.values() for name, place in own.items()}

    def put(self, name: str, scan_mm: Sequence[float] | None) -> None:
        """Set a mark, or remove it (None), and save.

        Raises
        ------
        StapeskitError
            A file was changed elsewhere.
        """
        key = "landmarks" if name in LANDMARK_NAMES else "plate_fiducials"
        points = {other: place for other, place in self.points[key].items() if other != name}
        if scan_mm is not None:
            points[name] = _point(scan_mm)
        stated = key == "plate_fiducials" and all(other in self.references for other in points)
        rows: list[list[object]] = [["name", *_COLUMNS, *(("x_ref_mm", "y_ref_mm", "z_ref_mm") * stated)]]
        for other, place in points.items():
            rows.append([other, *place, *(self.references[other] if stated else ())])
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows)
        self._stamps[key] = replace_file(self._own(key), text.getvalue(), self._stamps[key])
        if not points:
            self._own(key).unlink()
            self._stamps[key] = None
        self.points[key] = points
        self.study.put("scan", **{key: self._own(key) if len(points) >= LEAST[key] else None})

    def _own(self, key: str) -> Path:
        return self.study.kept / f"{key}.csv"


def _point(place: Iterable[float]) -> Point:
    x, y, z = (round(float(value), 4) for value in place)
    return x, y, z


def _read(path: Path) -> dict[str, Point]:
    """Read a file of marks that was written here: it may hold none."""
    table = read_table(path, lambda _header, _file: ({*_COLUMNS}, {"name"}))
    column = table.texts["name"]
    places = zip(*(table.numbers[name] for name in _COLUMNS), strict=True)
    return {column.names[code]: _point(at) for code, at in zip(column.codes, places, strict=True)}
