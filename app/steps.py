"""The steps of a study, each in a child process: ``python -m app.steps STEP STUDY.toml``.

A step is what the commands do, in the study's folders. What the page shows of it is left in NAME_app/; the
child says stages at work, warnings and a fault on standard output, a JSON object a line. numpy is loaded
after `run` has set its number of threads, on which last digits depend: they are those of the commands.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
import traceback
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

from app.study_file import OwnFile, StudyFile
from stapeskit.command import INTERRUPTED, fault_sentence, run
from stapeskit.provenance import sha256
from stapeskit.warnings import Notice, once

if TYPE_CHECKING:
    from ct_inertia.results import MassResult
    from fitting.result import KDFit
    from kinematics.results import MotionResult

LABELS, MASS = "labels.seg.nrrd", "mass.json"
SHOWN = "shown.npz"


def _say(**words: Any) -> None:
    sys.stdout.write(json.dumps(words) + "\n")
    sys.stdout.flush()


def _tell(stage: str, share: float | None = None) -> None:
    _say(stage=stage, share=share)


def _warn(notices: Sequence[Notice]) -> None:
    _say(notices=[(notice.code, notice.text) for notice in notices])


def mass(study: StudyFile, *, hand_work: bool) -> None:
    """Find the stapes and measure its mass, with the labels that were drawn or without."""
    from ct_inertia.ct2mass import measure_mass
    from pipeline.study import in_keys

    folder = study.cut if hand_work else study.found
    options = study.mass_options(hand_work=hand_work)
    with options.as_keys():
        result = measure_mass(options, _tell)
    result = replace(result, notices=in_keys(result.notices, type(options)))
    result.write(folder, report=False)
    _keep_shown(result, folder)
    _warn(result.notices)


def _keep_shown(result: MassResult, folder: Path) -> None:
    """Leave what the page shows as plain arrays: it then loads no library that reads images or meshes."""
    import numpy as np

    from ct_inertia.scan.open_scan import open_labels

    shown: dict[str, Any] = {"of": sha256(folder / MASS)}
    for name, surface in (("stapes", result.stapes), ("plate", result.plate)):
        if surface is not None:
            shown[name] = surface.vertices_mm[surface.faces]
    if (folder / LABELS).is_file():
        labels, grid = open_labels(folder / LABELS)
        shown |= {"labels": labels.astype(np.uint8), "scan_from_index": grid.scan_from_index}

    def write(path: Path) -> None:
        with path.open("wb") as stream:
            np.savez_compressed(stream, **shown)

    OwnFile(folder / SHOWN).write(write)


def read_shown(folder: Path | None) -> dict[str, Any]:
    """Return labels, their ``scan_from_index``, and corners (faces, 3, 3), mm, of ``stapes`` and ``plate``.

    Empty where there is none, where they are damaged, or where a killed step left those of an earlier mass.
    """
    if folder is None:
        return {}
    import numpy as np

    try:
        with (folder / SHOWN).open("rb") as stream, np.load(stream) as shown:
            return dict(shown) if str(shown["of"]) == sha256(folder / MASS) else {}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error):
        return {}


def points(study: StudyFile) -> None:
    """Lay the measurement into the scan, and look at every beam."""
    from kinematics.options import MotionOptions
    from kinematics.points2dof import measure_motion
    from pipeline.study import in_keys
    from stapeskit.records.mass_file import read_mass_json

    folder = mass_folder(study)
    measured = None if folder is None else read_mass_json(folder / MASS)
    options = MotionOptions.from_study(study.tables.get("ldv", {}), study.path.name, study.path.parent)
    with options.as_keys():
        result = measure_motion(options, measured, _tell)
    result = replace(result, motion=replace(result.motion, notices=in_keys(result.notices, type(options))))
    _warn(result.notices)
    result.write(study.points.parent)
    content = {"laid_with": laid_with(study), **points_content(result)}
    OwnFile(study.kept / "measured.json").write(json.dumps(content))


def laid_with(study: StudyFile) -> list[Any]:
    """Return what the measurement is laid into the scan with: its table of the study, and the mass."""
    folder = mass_folder(study)
    return [study.tables.get("ldv", {}), "" if folder is None else sha256(folder / MASS)]


def points_content(result: MotionResult) -> dict[str, Any]:
    """Return (body, verdict, place in scan mm) of every point, and what can be left out: points and beams."""
    import numpy as np

    from kinematics.measurement import direction_name
    from kinematics.report.motion import motion_scene

    places = []
    if result.mass is not None:
        pose = result.mass.scan_from_footplate
        for point in motion_scene(result).points:
            at = [round(float(value), 4) for value in pose.points(np.asarray(point.position_mm))]
            places.append((point.body, point.verdict, at))
    beams = [(f"{one.body}:{one.point}", direction_name(one.direction)) for one in result.channels]
    names = [name for point, beam in beams for name in (f"{point}:{beam}".replace(", ", ","), point)]
    return {"points": places, "beams": list(dict.fromkeys(names))}


def fit(study: StudyFile) -> None:
    """Run the study as ``scan2kd`` does."""
    from pipeline.run import run_study

    fitted = run_study(study.path, study.out, progress=_tell, tell=_warn).fit
    kd = json.loads((study.out / "kd.json").read_text(encoding="utf-8"))
    content = {"of": kd["fit"], "responses": response_rows(fitted)}
    OwnFile(study.kept / "fit.json").write(json.dumps(content))


def response_rows(result: KDFit) -> list[dict[str, Any]]:
    """Return measured and fitted responses for curves, a row a value."""
    import numpy as np

    from fitting.report.figures import responses
    from stapeskit.report.figures import dof_unit

    shown, rows = responses(result), []
    order = np.argsort(shown.freq_hz, kind="stable")
    for place, name in enumerate(result.dof):
        scale, symbol = dof_unit(name)
        both = {"measured": shown.measured[:, place], "fitted": shown.simulated[:, place]}
        smooth = np.empty(len(order))  # no jumps of a turn, which a line would draw
        smooth[order] = np.unwrap(np.angle(both["fitted"])[order])
        for kind, values in both.items():
            amplitude, phase = scale * np.abs(values), np.degrees(smooth + np.angle(values / both["fitted"]))
            for at in zip(shown.freq_hz.tolist(), amplitude.tolist(), phase.tolist(), strict=True):
                named = dict(zip(("frequency, Hz", "amplitude", "phase"), at, strict=True))
                rows.append({"motion": f"{name}, {symbol}", "kind": kind, **named})
    return rows


def mass_folder(study: StudyFile) -> Path | None:
    """Return the folder with the mass of the study: of the corrected cut, else of the found one."""
    drawn = study.cut if study.labels_are_ours else study.found
    return next((one for one in (drawn, study.found) if (one / MASS).is_file()), None)


STEPS: dict[str, tuple[str, Callable[[StudyFile], None]]] = {
    "found": ("Measuring the stapes", partial(mass, hand_work=False)),
    "cut": ("Measuring the corrected cut", partial(mass, hand_work=True)),
    "points": ("Looking at the measurement", points),
    "fit": ("Fitting stiffness and damping", fit),
}
"""Steps by name: their titles, and what they do."""


class Job:
    """A step of `STEPS` at work in a child process, begun when this is made."""

    def __init__(self, step: str, study: StudyFile) -> None:
        self.step, self.stage = step, "starting"
        self.share: float | None = None  # the part of the stage that is done
        self.notices: tuple[Notice, ...] = ()  # each once: several may have one code
        self._fault, self._stopped = "", False
        self._began = self._stage_began = time.monotonic()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "app.steps", step, str(study.path)],
            stdout=subprocess.PIPE,
            cwd=Path(__file__).parents[1],
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self._process.stdout or ():
            try:
                word = json.loads(line)
            except ValueError:  # what a library printed
                continue
            self.notices = once([*self.notices, *(Notice(*pair) for pair in word.get("notices", ()))])
            self._fault = word.get("fault", self._fault)
            if "stage" in word:
                if word["stage"] != self.stage:
                    self._stage_began = time.monotonic()
                self.stage, self.share = word["stage"], word["share"]

    @property
    def running(self) -> bool:
        """Whether it is still at work."""
        return self._process.poll() is None

    @property
    def progress(self) -> str:
        """Title, stage, share and time left in one line."""
        now = time.monotonic()
        text = f"{STEPS[self.step][0]}: {self.stage}, {now - self._began:.0f} s"
        if self.share is not None and 0.02 < self.share < 1.0:
            left = (now - self._stage_began) * (1.0 - self.share) / self.share
            text += f", {100.0 * self.share:.0f} %, about {left:.0f} s left"
        return text

    @property
    def done(self) -> str:
        """Say that it has ended."""
        return f"{STEPS[self.step][0]}: done in {time.monotonic() - self._began:.0f} s."

    def stop(self) -> None:
        """End it; what finished stages have written stays."""
        self._stopped = True
        self._process.terminate()

    def fault(self) -> str:
        """Wait for its end and return what was wrong: empty when all went well, never a traceback."""
        code = self._process.wait()
        self._reader.join()
        if self._process.stdout is not None:
            self._process.stdout.close()
        if self._stopped or code == INTERRUPTED:
            return "Stopped; what was there before is unchanged."
        killed = "The step ended before it was done, most often because memory ran out: close other programs."
        return self._fault or (killed if code else "")


def work(words: list[str]) -> None:
    """Run the step that the words name; what is wrong is said in the sentence of the commands."""
    step, path = words[0], Path(words[1])
    try:
        STEPS[step][1](StudyFile.read(path))
    except Exception as error:
        sentence = fault_sentence(error)
        if sentence is None:
            log = StudyFile(path).kept / "failure.txt"
            OwnFile(log).write(traceback.format_exc())
            sentence = f"stapeskit failed in this step. This is a bug, not your input: please report {log}."
        _say(fault=sentence)


if __name__ == "__main__":
    run("stapeskit app", work)
