"""Points that are set by clicking: anatomical landmarks, and the marks of fiducials.csv on the plate."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from app.study_file import StudyFile, check_unchanged, replace_file, stamp
from ct_inertia.frames.anatomy import LANDMARK_NAMES

LEAST_PLATE_MARKS = 3
"""Fewer define no plate frame: they are kept, but the study does not use them yet."""

Point = tuple[float, float, float]
_FILES = {"landmarks": "_landmarks.csv", "plate_fiducials": "_plate_fiducials.csv"}


class Marks:
    """Marks of a study in scan coordinates, mm, saved at every change.

    Attributes
    ----------
    landmarks, plate : dict of str to (x, y, z)
    references : dict of str to (x, y, z)
        Where the marks of the plate are in the plate frame, by fiducials.csv, mm.
    """

    def __init__(self, study: StudyFile) -> None:
        self.study = study
        self.landmarks: dict[str, Point] = {}
        self.plate: dict[str, Point] = {}
        self.references: dict[str, Point] = {}
        self._stamps: dict[str, tuple[int, int] | None] = {}
        self.reload()

    def reload(self) -> None:
        """Read what the study names.

        Raises
        ------
        StapeskitError
            A file of landmarks, fiducials or marks is at fault.
        """
        from ct_inertia.frames.fiducials import read_plate_fiducials
        from ct_inertia.frames.landmarks import read_landmarks

        if (path := self.study.file("scan", "landmarks")) is not None:
            self.landmarks = {name: _point(place) for name, place in read_landmarks(path).items()}
        path = self.study.file("scan", "plate_fiducials") or self._own("plate_fiducials")
        if path.exists():
            self.plate = _read_points(path)
            if self.study.get("scan", "plate_fiducials"):
                given = read_plate_fiducials(path)
                self.plate = {name: _point(at) for name, at in zip(given.names, given.scan_mm, strict=True)}
        for key in _FILES:
            self._stamps[key] = stamp(self._own(key))
        self.use_fiducials()

    def use_fiducials(self) -> None:
        """Take the names of plate marks, and their places on the plate, from the study's fiducials."""
        from kinematics.place.fiducials import read_fiducials

        path = self.study.file("ldv", "fiducials")
        self.references = {}
        if path is not None:
            known = read_fiducials(path)
            self.references = {
                name: _point(place)
                for name, place, frame in zip(known.names, known.reference_mm, known.frames, strict=True)
                if frame == "plate"
            }

    @property
    def names(self) -> list[str]:
        """Every mark that can be set."""
        return [*LANDMARK_NAMES, *self.references]

    @property
    def placed(self) -> dict[str, Point]:
        """Every mark that is set."""
        return {**self.landmarks, **self.plate}

    def put(self, name: str, scan_mm: Sequence[float] | None) -> None:
        """Set a mark, or remove it (None), and save.

        Raises
        ------
        StapeskitError
            A file was changed elsewhere.
        """
        key = "landmarks" if name in LANDMARK_NAMES else "plate_fiducials"
        own = self.landmarks if key == "landmarks" else self.plate
        before = dict(own)
        own.pop(name, None)
        if scan_mm is not None:
            own[name] = _point(scan_mm)
        try:
            self._save(key, own)
        except Exception:
            own.clear()
            own.update(before)
            raise

    def _save(self, key: str, points: Mapping[str, Point]) -> None:
        path = self._own(key)
        check_unchanged(path, self._stamps[key])
        rows: list[list[object]] = [["name", "x_mm", "y_mm", "z_mm"]]
        if key == "plate_fiducials" and self.references:
            rows[0] += ["x_ref_mm", "y_ref_mm", "z_ref_mm"]
        for name, place in points.items():
            reference = self.references.get(name, ()) if len(rows[0]) > 4 else ()
            rows.append([name, *place, *reference])
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows)
        replace_file(path, text.getvalue())
        self._stamps[key] = stamp(path)
        least = LEAST_PLATE_MARKS if key == "plate_fiducials" else 1
        self.study.put("scan", **{key: path if len(points) >= least else None})

    def _own(self, key: str) -> Path:
        return self.study.places.beside(_FILES[key])


def _point(place: Iterable[float]) -> Point:
    x, y, z = (round(float(value), 4) for value in place)
    return x, y, z


def _read_points(path: Path) -> dict[str, Point]:
    """Read marks that are too few for `read_plate_fiducials`."""
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {row["name"]: _point([float(row[f"{axis}_mm"]) for axis in "xyz"]) for row in rows}
