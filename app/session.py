"""State and actions of one open page, without any layout; a script can use them too."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from app.drawing import Change, Drawing, Labels
from app.job import Job
from app.marks import Marks
from app.study_file import StudyFile, check_unchanged, stamp
from app.work import mass_folder
from ct_inertia.scan.scan import Scan
from pipeline.new_study import ASSUMED_DENSITY, look
from stapeskit.documents import read_json
from stapeskit.faults import StapeskitError

LABELS = "labels.seg.nrrd"
MEASUREMENTS = (".csv", ".txt", ".uff", ".unv", ".mat", ".h5", ".hdf5", ".svd")
_DAMAGED = ("the mass of an earlier step", "Remove its folder, and measure again")


class Session:
    """A study at work.

    Attributes
    ----------
    folder : Path
        Where the page begins to look for files.
    study : StudyFile or None
    scan : Scan or None
        Opened, for the picture.
    drawing : Drawing or None
        Labels, once the stapes was found.
    marks : Marks or None
    job : Job or None
        The step at work, or the last one.
    mass : dict of str to dict
        ``found`` and ``cut``: content of their mass.json.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder).absolute()
        self.study: StudyFile | None = None
        self.scan: Scan | None = None
        self.drawing: Drawing | None = None
        self.marks: Marks | None = None
        self.job: Job | None = None
        self.mass: dict[str, dict[str, Any]] = {}
        self._hand: Path | None = None  # the labels that were drawn, and how they were left
        self._hand_seen: tuple[int, int] | None = None
        self._corners: dict[int, list[float]] = {}

    @property
    def opened_study(self) -> StudyFile:
        """The study.

        Raises
        ------
        StapeskitError
            There is none yet.
        """
        if self.study is None:
            raise StapeskitError("Choose a scan, or open a study, first.")
        return self.study

    def begin(self, scan: Path, name: str = "") -> None:
        """Begin a study of a scan; files beside it that belong to it are taken along. Nothing is written yet.

        Parameters
        ----------
        scan : Path
        name : str
            Of the study; without it that of the scan.

        Raises
        ------
        StapeskitError
            The name is taken or unfit, or the scan cannot be read.
        """
        scan = Path(scan).absolute()
        study = StudyFile.new(scan.parent, name or _free_name(scan))
        study.text = study.changed("scan", file=scan)
        beside = look(scan.parent)
        if len(beside.measurements) == 1:
            tied = {key: beside.others.get(key) for key in ("points", "fiducials")}
            study.text = study.changed("ldv", file=beside.measurements[0], **tied)
        self._take(study)

    def open(self, path: Path) -> None:
        """Go on with a study where it stopped.

        Raises
        ------
        StapeskitError
            The study, or a file that it names, is at fault.
        """
        self._take(StudyFile.read(path))

    def _take(self, study: StudyFile) -> None:
        """Take a study in place of the one that was open, when all that it names can be read."""
        from app.grey import opened

        if self.job is not None and self.job.running:
            raise StapeskitError("A step is at work; wait for it, or stop it.")
        new = Session(self.folder)
        new.study, new.marks = study, Marks(study)
        new.scan = opened(study.mass_options(hand_work=False))
        new.take_results()
        self.__dict__.update(new.__dict__)

    def rename(self, name: str) -> None:
        """Give another name to a study that was not saved yet.

        Raises
        ------
        StapeskitError
            It was saved, or the name is taken or unfit.
        """
        study = self.opened_study
        if name == study.path.stem:
            return
        if study.path.exists():
            step = "Begin with the scan again to have it under another name"
            raise StapeskitError.of("the name", "that of the saved study", name, study.path.name, step)
        study.path = StudyFile.new(study.path.parent, name).path
        study.text = study.changed("study", name=study.path.stem)

    def set_scan(self, density: str, side: str | None) -> None:
        """Write density and side into the study; an assumed density is left out, so that results say so."""
        study, stated = self.opened_study, density.replace(" ", "").replace("±", "+-")
        study.put("study" if study.get("study", "side") else "scan", side=side)
        study.put("scan", density_kg_m3=None if stated in ("", ASSUMED_DENSITY) else stated)

    def put_search(self, **values: Any) -> None:
        """Keep what the stapes is found by: ``seed_mm``, ``box_mm``."""
        if self.opened_study.labels_are_ours:
            raise StapeskitError("Go back to the cut as found first: labels say where the stapes is.")
        self.opened_study.put("scan", **values)

    def put_box_corner(self, corner: int, scan_mm: Sequence[float]) -> None:
        """Keep one of two corners of the box to search; with both the box holds."""
        self._corners[corner] = [round(float(value), 4) for value in scan_mm]
        if len(self._corners) == 2:
            corners = np.sort(list(self._corners.values()), axis=0)
            self.put_search(box_mm=corners.ravel().tolist())

    def forget_search(self) -> None:
        """Forget seed and box."""
        self._corners.clear()
        self.put_search(seed_mm=None, box_mm=None)

    def search_text(self) -> str:
        """Return seed and box in words."""
        if self.study is None:
            return ""
        known = {"seed": self.study.get("scan", "seed_mm"), "box": self.study.get("scan", "box_mm")}
        texts = [f"{name}: {', '.join(f'{v:g}' for v in value)}" for name, value in known.items() if value]
        corners = [", ".join(f"{v:g}" for v in place) for place in self._corners.values()]
        return "; ".join([*texts, *(f"corner: {place}" for place in corners if not known["box"])])

    def set_measurement(self, key: str, name: str | None) -> None:
        """Choose the vibrometer file, its points or its fiducials."""
        self.opened_study.put("ldv", **{key: name})
        if self.marks is not None and key == "fiducials":
            self.marks.use_fiducials()

    def leave_out_choice(self) -> tuple[list[str], list[str]]:
        """Return the channels that can be left out, and those that are."""
        measured = self.content("points") or {"beams": []}
        every = [name for beam in measured["beams"] for name in (beam["channel"], beam["channel_point"])]
        return self._choice("ldv", "leave_out", every)

    def reasons(self) -> tuple[list[str], list[str]]:
        """Return the codes that the verdict rests on or that are confirmed, and the confirmed ones."""
        fitted = self.content("fit") or {"verdict": {"reasons": []}}
        return self._choice("study", "confirmed", [one["code"] for one in fitted["verdict"]["reasons"]])

    def _choice(self, table: str, key: str, every: list[str]) -> tuple[list[str], list[str]]:
        """Return what can be chosen for a key, and what the study has chosen."""
        value = (self.study.get(table, key) if self.study else None) or []
        chosen = [value] if isinstance(value, str) else list(value)
        return list(dict.fromkeys([*chosen, *every])), chosen

    def report(self) -> Path:
        """Return the report of the last fit.

        Raises
        ------
        StapeskitError
            There is none yet.
        """
        path = self.opened_study.out / "report.html"
        if not path.is_file():
            raise StapeskitError("There is no report yet: press Fit first.")
        return path

    def start(self, step: str) -> Job:
        """Begin a step.

        Raises
        ------
        StapeskitError
            Another one is at work, or what it needs is not there yet.
        """
        study = self.opened_study
        if self.job is not None and self.job.running:
            raise StapeskitError("A step is at work; wait for it, or stop it.")
        if step == "cut" and not study.labels_are_ours:
            raise StapeskitError("Nothing was drawn: the cut as found was measured already.")
        if step in ("points", "fit") and not study.get("ldv", "file"):
            raise StapeskitError("Choose a vibrometer file first.")
        if not study.path.exists():
            study.save(study.text)
        self.job = Job(step, study)
        return self.job

    def finish(self) -> str:
        """Take what the step made and return its fault, empty when all went well."""
        fault = self.job.fault() if self.job is not None else ""
        try:
            if not fault:
                self.take_results()
        except StapeskitError as error:
            return str(error)
        return fault

    def take_results(self) -> None:
        """Read what the steps have left."""
        study = self.opened_study
        files = {name: getattr(study, name) / "mass.json" for name in ("found", "cut")}
        self.mass = {name: read_json(path, *_DAMAGED) for name, path in files.items() if path.is_file()}
        if "found" in self.mass:
            self._read_labels()

    def _read_labels(self) -> None:
        from ct_inertia.scan.open_scan import open_labels

        study = self.opened_study
        read, grid = open_labels(study.found / LABELS)
        found: Labels = read.astype(np.uint8)
        if self.drawing is not None and np.array_equal(self.drawing.found, found):
            return
        labels: Labels = found.copy()
        self._hand = self._hand_seen = None
        hand = study.file("scan", "labels")
        if study.labels_are_ours and hand is not None and hand.exists():
            seen = stamp(hand)
            drawn, drawn_grid = open_labels(hand)
            same = drawn.shape == found.shape
            if same and np.allclose(drawn_grid.scan_from_index, grid.scan_from_index, atol=1e-6):
                labels, self._hand, self._hand_seen = drawn.astype(np.uint8), hand, seen
        self.drawing = Drawing(labels, np.asarray(grid.scan_from_index), found)

    def end_stroke(self) -> None:
        """Save the labels after a stroke, and name them in the study.

        Raises
        ------
        StapeskitError
            The labels or the study were changed elsewhere.
        """
        if self.drawing is not None and self.drawing.end_stroke():
            self._save_labels()

    def undo(self) -> Change | None:
        """Take the last stroke back and save."""
        if self.drawing is None:
            return None
        change = self.drawing.undo()
        if change.index.size:
            self._save_labels()
        return change

    def reset(self) -> None:
        """Return to the cut as found."""
        if self.drawing is not None:
            self.drawing.reset()
            self._save_labels()

    def _save_labels(self) -> None:
        """Write the labels that were drawn; labels as found are not given back, so that nothing changes."""
        study, drawing = self.opened_study, self.drawing
        if drawing is None:
            return
        if self._hand is None:
            self._hand = _unused(study.kept / LABELS)
        check_unchanged(self._hand, self._hand_seen)
        drawing.write(self._hand)
        self._hand_seen = stamp(self._hand)
        if not drawing.as_found:
            study.put_labels(self._hand)
        elif study.labels_are_ours:
            study.put_labels(None)

    def surfaces(self) -> dict[str, Path]:
        """Return the surfaces of the study's current mass, by name."""
        folder = None if self.study is None else mass_folder(self.study)
        files = {} if folder is None else {name: folder / f"{name}.ply" for name in ("stapes", "plate")}
        return {name: path for name, path in files.items() if path.is_file()}

    @property
    def masses(self) -> dict[str, dict[str, Any]]:
        """Content of mass.json of the cut as found and, while labels are drawn, of the corrected one."""
        drawn = self.study is not None and self.study.labels_are_ours
        return {name: mass for name, mass in self.mass.items() if drawn or name != "cut"}

    def content(self, name: str) -> Any:
        """Return what a step left for the page, ``points`` or ``fit``; None without it."""
        try:
            return json.loads((self.opened_study.kept / f"{name}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):  # a StapeskitError, too, is a ValueError
            return None

    def files(self) -> list[str]:
        """Return the names of the files that can be a measurement, its points or its fiducials."""
        if self.study is None:
            return []
        folder = self.study.path.parent
        found = [path.name for path in sorted(folder.iterdir()) if path.suffix.lower() in MEASUREMENTS]
        named = [str(value) for value in self.study.tables.get("ldv", {}).values()]
        return list(dict.fromkeys([*found, *(name for name in named if (folder / name).exists())]))

    def repeat_text(self) -> str:
        """Say where all results are, and which command makes them again."""
        study = self.opened_study
        return f"All results: {study.out}. Again: scan2kd {shlex.quote(str(study.path))}"

    def other_results(self) -> list[str]:
        """Return the other folders next to the study that hold K and D."""
        if self.study is None:
            return []
        own = self.study.out
        return [p.parent.name for p in sorted(own.parent.glob("*/kd.json")) if p.parent.name != own.name]


def _free_name(scan: Path) -> str:
    """Return the name of a scan, numbered where there is a study of that name."""
    from ct_inertia.scan.formats import stem_of

    return _unused(scan.with_name(f"{stem_of(scan.name)}.toml")).stem


def _unused(path: Path) -> Path:
    """Return a path, numbered where there is a file of that name."""
    stem, suffix = path.name.split(".", 1) if path.name == LABELS else (path.stem, path.suffix[1:])
    free, number = path, 1
    while free.exists():
        number += 1
        free = path.with_name(f"{stem}_{number}.{suffix}")
    return free
