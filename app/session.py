"""State and actions of one open page, without any layout; a script can use them too."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from app.drawing import Change, Drawing
from app.marks import Marks
from app.steps import LABELS, MASS, Job, laid_with, mass_folder, read_shown
from app.study_file import OwnFile, StudyFile
from ct_inertia.options import ASSUMED_DENSITY
from ct_inertia.scan.formats import stem_of
from ct_inertia.scan.scan import Scan
from kinematics.readers.text import ENDINGS
from pipeline.new_study import lacking, look
from stapeskit.arrays import Array
from stapeskit.documents import read_json
from stapeskit.faults import StapeskitError

_DAMAGED = ("the mass of an earlier step", "Remove its folder, and measure again")


class Session:
    """A study at work: its file, what its steps found, and what is drawn and marked.

    Every action raises `StapeskitError` with the sentence that the page shows; nothing is changed then.
    """

    def __init__(self, study: StudyFile) -> None:
        self.study, self.marks = study, Marks(study)  # empty ones until a scan or a study is chosen
        self.scan: Scan | None = None
        self.lacking: tuple[str, ...] = ()  # keys of [scan] without which the scan cannot be opened
        self.drawing: Drawing | None = None  # labels, once the stapes was found
        self.job: Job | None = None  # the step at work, or the last one
        self.mass: dict[str, dict[str, Any]] = {}  # content of mass.json of ``found`` and ``cut``
        self._hand: OwnFile | None = None  # the labels that were drawn

    def open(self, path: Path) -> str:
        """Begin a study of a scan, with the files beside it that belong to it, or go on with a study (.toml).

        Returns what has to be done before it can be shown whole, empty where nothing. The study that was open
        stays where something is wrong. A new one is written with the first change.
        """
        self._check_idle()
        opened = Session(StudyFile.read(path) if path.suffix == ".toml" else _begun(path))
        lacks = opened.open_scan()
        hidden = opened.take_results()
        self.__dict__ = opened.__dict__
        stem, name = stem_of(path.name), opened.study.path.name
        if path.suffix != ".toml" and name != f"{stem}.toml":
            hidden = f"This begins {name}: choose {stem}.toml instead to go on with what was done."
        return f"{lacks} There is a field for it." if lacks else hidden

    def open_scan(self) -> str:
        """Open the scan as the study says; return what it still lacks, empty where nothing."""
        from ct_inertia.scan.open_scan import open_scan

        self.scan, self.drawing, self.mass, lacks = None, None, {}, ""
        if "scan" in self.study.tables:
            of = self.study.mass_options(hand_work=False)
            self.lacking, lacks = lacking(of)
            if of.file is not None and not of.is_mesh and not lacks:
                with of.as_keys():
                    self.scan = open_scan(of.file, of.spacing_mm, of.mirror, of.nan_as_air, of.raw)
        return lacks

    def set_voxels(self, **words: str | None) -> str:
        """Write spacing or layout of the voxels into the study; return what the scan still lacks."""
        self._check_idle()
        if self.study.path.exists():
            self.study.put("scan", **words)
        else:  # it is saved with the first step: until then its name can change
            self.study.text = self.study.checked("scan", **words)
        return self.open_scan()

    def _check_idle(self) -> None:
        if self.job is not None and self.job.running:
            raise StapeskitError("A step is at work; wait for it, or stop it.")

    def set_scan(self, name: str, density: str, side: str | None) -> None:
        """Write name, density and side into the study; an assumed density is left out: results say so."""
        study, stated = self.study, density.replace(" ", "").replace("±", "+-")
        if name.strip() != study.path.stem:
            if study.path.exists():
                step = "Begin with the scan again to have it under another name"
                raise StapeskitError.of("the name", "that of the saved study", name, study.path.name, step)
            self.study = study = StudyFile.new(study.path.parent, name, study.text)
            self.marks = Marks(study)
        study.put("study" if study.get("study", "side") else "scan", side=side)
        study.put("scan", density_kg_m3=None if stated in ("", str(ASSUMED_DENSITY)) else stated)

    def set_measurement(self, key: str, name: str | None) -> None:
        """Choose the vibrometer file, its points or its fiducials."""
        self.study.put("ldv", **{key: name})
        self.marks.use_fiducials()

    def choices(self, table: str, key: str) -> tuple[list[str], list[str]]:
        """Return what can be ticked for ``leave_out`` or ``confirmed``, and what is."""
        value = self.study.get(table, key) or []
        chosen = [value] if isinstance(value, str) else list(value)
        reasons = _content(self.study.out / "kd.json").get("verdict", {}).get("reasons", ())
        known = [reason["code"] for reason in reasons]
        if key == "leave_out":
            known = self.content("measured").get("beams", [])
        return list(dict.fromkeys([*chosen, *known])), chosen

    def start(self, step: str) -> None:
        """Begin a step."""
        self._check_idle()
        if step == "cut" and not self.study.labels_are_ours:
            raise StapeskitError("Nothing was drawn: the cut as found was measured already.")
        if step in ("points", "fit") and not self.study.get("ldv", "file"):
            raise StapeskitError("Choose a vibrometer file first.")
        self.study.put("scan")
        self.job = Job(step, self.study)

    def finish(self) -> str:
        """Take what the step made; return its fault, or what is not shown, empty when all went well."""
        fault = self.job.fault() if self.job is not None else ""
        try:
            return fault or self.take_results()
        except StapeskitError as error:
            return str(error)

    def take_results(self) -> str:
        """Read what the steps have left; return what of it cannot be shown, empty where all is."""
        files = {"found": self.study.found / MASS, "cut": self.study.cut / MASS}
        self.mass = {name: read_json(path, *_DAMAGED) for name, path in files.items() if path.is_file()}
        return self._read_labels() if "found" in self.mass else ""

    def _read_labels(self) -> str:
        shown = read_shown(self.study.found)
        if "labels" not in shown:
            # labels that were measured alone (a mesh has none) and are not there: a step was killed
            gone = self.scan is not None and self.drawing is None
            return "What was found cannot be shown: press Measure; what was drawn is kept." if gone else ""
        found, place = shown["labels"], shown["scan_from_index"]
        if self.drawing is not None and np.array_equal(self.drawing.found, found):
            return ""
        labels, self._hand = found.copy(), None
        path = self.study.file("scan", "labels")
        if self.study.labels_are_ours and path is not None and path.exists():
            from ct_inertia.scan.open_scan import open_labels

            hand = OwnFile(path)
            drawn, grid = open_labels(path)
            if drawn.shape == found.shape and np.allclose(grid.scan_from_index, place, atol=1e-6):
                labels, self._hand = drawn.astype(np.uint8), hand
        self.drawing = Drawing(labels, place, found)
        if self.study.labels_are_ours and self._hand is None:
            return (
                f"The picture shows the cut as found, while the study uses {path}, which was drawn on other "
                "voxels: go back to the cut as found, or draw anew. That file is kept."
            )
        return ""

    def end_stroke(self) -> None:
        """Save the labels after a stroke, and name them in the study."""
        if self.drawing is not None and self.drawing.end_stroke():
            self._save_labels(self.drawing)

    def undo(self) -> Change | None:
        """Take the last stroke back and save."""
        if self.drawing is None:
            return None
        change = self.drawing.undo()
        if change is not None:
            self._save_labels(self.drawing)
        return change

    def reset(self) -> Change | None:
        """Return to the cut as found; what was drawn stays in its file: the next stroke begins another."""
        self._hand = None
        if self.study.labels_are_ours:
            self.study.put_labels(None)
        return None if self.drawing is None else self.drawing.reset()

    def _save_labels(self, drawing: Drawing) -> None:
        """Write the labels that were drawn; labels as found are not given back, so that nothing changes."""
        if self._hand is None:
            self._hand = OwnFile(_unused(self.study.kept, *LABELS.split(".", 1)))
        self._hand.write(drawing.write)
        if not drawing.as_found:
            self.study.put_labels(self._hand.path)
        elif self.study.labels_are_ours:
            self.study.put_labels(None)

    def surfaces(self) -> dict[str, Array]:
        """Return the surfaces of the study's current mass by name, corners (faces, 3, 3), scan mm."""
        shown = read_shown(mass_folder(self.study))
        return {name: shown[name] for name in ("stapes", "plate") if name in shown}

    def content(self, name: str) -> dict[str, Any]:
        """Return what a step left for the page, ``measured`` or ``fit``; empty without it."""
        return _content(self.study.kept / f"{name}.json")

    @property
    def responses(self) -> list[dict[str, Any]]:
        """The curves of the fit; none where K and D are now those of another one, made by scan2kd."""
        drawn, now = self.content("fit"), _content(self.study.out / "kd.json")
        return drawn["responses"] if "of" in drawn and drawn["of"] == now.get("fit") else []

    @property
    def pages(self) -> dict[str, Path]:
        """The pages of the whole study and of the measurement by name, the one written last first."""
        pages = {"K and D": self.study.out / "report.html", "measurement": self.study.points}
        there = {name: page for name, page in pages.items() if page.is_file()}
        return dict(sorted(there.items(), key=lambda one: -_time(one[1])))

    @property
    def outgrown(self) -> list[str]:
        """What was made before the study, or what was drawn or marked, was changed: with its step."""
        study, pages, folder = self.study, self.pages, mass_folder(self.study)
        labels = [study.file("scan", "labels")] if study.labels_are_ours else []
        changed = max((_time(one) for one in (*study.kept.glob("*.csv"), *labels) if one), default=0)
        mass = folder is not None and (
            _time(folder / MASS) < changed or self._measured_otherwise(folder.name)
        )
        laid_anew = self.content("measured").get("laid_with") != laid_with(study)
        old = {
            "mass (1 or 2)": mass,
            "measurement (4)": "measurement" in pages and (mass or laid_anew),
            "K and D (5)": "K and D" in pages and _time(pages["K and D"]) < max(changed, _time(study.path)),
        }
        return [name for name, is_old in old.items() if is_old]

    def _measured_otherwise(self, name: str) -> bool:
        """Return whether ``found`` or ``cut`` was measured with other options than the study has."""
        try:
            given = self.study.mass_options(hand_work=name == "cut").given()
        except StapeskitError:
            return True
        used = self.mass.get(name, {}).get("provenance", {}).get("parameters")
        # files by their names: the study may have been moved
        now, then = (
            {key: Path(value).name if isinstance(value, str) else value for key, value in one.items()}
            for one in (given, used or {})
        )
        return used is not None and now != then

    def files(self) -> list[str]:
        """Return the names of the files that can be a measurement, its points or its fiducials."""
        folder = self.study.path.parent
        found = [path.name for path in sorted(folder.iterdir()) if path.suffix.lower() in ENDINGS]
        named = [str(value) for value in self.study.tables.get("ldv", {}).values()]
        return list(dict.fromkeys([*found, *(name for name in named if (folder / name).exists())]))

    def other_results(self) -> list[str]:
        """Return the other folders next to the study that hold K and D."""
        folders = sorted(path.parent for path in self.study.path.parent.glob("*/kd.json"))
        return [folder.name for folder in folders if folder != self.study.out]


def _time(path: Path) -> int:
    """Return when a file was written, ns; 0 where there is none."""
    return path.stat().st_mtime_ns if path.is_file() else 0


def _content(path: Path) -> dict[str, Any]:
    """Return the content of a file that a step writes, empty where it is not there or damaged."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def _begun(scan: Path) -> StudyFile:
    """Return a new study of a scan, named after it, with the only measurement beside it."""
    scan = Path(scan).absolute()
    study = StudyFile.new(scan.parent, _unused(scan.parent, stem_of(scan.name), "toml").stem)
    study.text = study.changed("scan", file=scan)
    beside = look(scan.parent)
    if len(beside.measurements) == 1:
        tied = {key: beside.others.get(key) for key in ("points", "fiducials")}
        study.text = study.changed("ldv", file=beside.measurements[0], **tied)
    return study


def _unused(folder: Path, stem: str, suffix: str) -> Path:
    """Return a path, numbered where there is a file of that name."""
    number = 1
    while (path := folder / f"{stem}{f'_{number}' * (number > 1)}.{suffix}").exists():
        number += 1
    return path
