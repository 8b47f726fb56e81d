"""Make a study.toml from the files of a folder; what they do not say is asked, or left off."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ct_inertia.options import ASSUMED_DENSITY
from kinematics.readers.text import TEXT_ENDINGS
from stapeskit.faults import StapeskitError
from stapeskit.options import toml
from stapeskit.outputs import MANIFEST, Outputs, written_in

if TYPE_CHECKING:
    from ct_inertia.options import MassOptions

STUDY = "study.toml"
SAMPLE = "stapeskit sample"  # writes inputs, not results
_LOOKED_AT = 1 << 16  # bytes of a text: headers of exports end before
_VALUE = re.compile(r"(?<![\w.])[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?(?![\w])")
Ask = Callable[[str], str]
LAYOUT, SPACING = ("shape", "dtype"), ("spacing_mm",)
QUESTIONS: dict[tuple[str, ...], str] = {
    LAYOUT: "Voxels along x, y, z and their type, which no file says, as NX,NY,NZ uint16 "
    "(empty: filled in later): ",
    SPACING: "Size of a voxel in mm, H or DX,DY,DZ, which no file says (empty: filled in later): ",
    ("density_kg_m3",): f"Density of the bone, kg/m3, as VALUE+-SD (empty: {ASSUMED_DENSITY} is assumed): ",
    ("side",): "Left or right ear (empty: not known): ",
    ("anterior",): "Direction towards anterior in scan axes, x,y,z (empty: not known): ",
}
"""What no file says, by keys of [scan], a word each; the options of ct2mass check the answers."""


@dataclass(frozen=True)
class Found:
    """What the files of a folder are: every file that can be a scan or a measurement."""

    scans: list[Path] = field(default_factory=list)
    measurements: list[Path] = field(default_factory=list)
    others: dict[str, Path] = field(default_factory=dict)  # fiducials, labels ..., by their key


def look(folder: Path) -> Found:
    """Recognise the files of a folder by their names and first bytes."""
    from ct_inertia.scan.formats import format_of as scan_format
    from kinematics.readers.formats import format_of as measurement_format

    found = Found()
    names = {"points.csv": "points", "fiducials.csv": "fiducials", "plate_fiducials.csv": "plate_fiducials"}
    made = {name for command, files in written_in(Path(folder)).items() for name in files
            if command != SAMPLE}  # fmt: skip
    for path in sorted(Path(folder).iterdir()):
        lower = path.name.lower()
        if path.name in made or (path / MANIFEST).is_file():
            continue  # results of an earlier command
        other = lower.endswith((".toml", ".json", ".md", ".html")) and not lower.endswith(".mrk.json")
        if path.name.startswith(".") or other:
            continue
        if lower in names:
            found.others[names[lower]] = path
        elif lower.endswith((".seg.nrrd", "labels.nrrd", "labels.nii.gz", "labels.mha")):
            found.others["labels"] = path
        elif lower.endswith((".mrk.json", ".fcsv")) or lower == "landmarks.csv":
            found.others["landmarks"] = path
        elif path.is_dir() and not _holds_slices(path) and not _is_volume(path):
            continue
        elif _is(partial(scan_format, path)) and not lower.endswith((".csv", ".txt")):
            found.scans.append(path)
        elif path.is_file() and _holds_values(path) and _is(partial(measurement_format, path)):
            found.measurements.append(path)
    headers = {path.stem for path in found.scans if not _is_raw(path)}
    found.scans[:] = [path for path in found.scans if path.stem not in headers or not _is_raw(path)]
    return found


def _holds_slices(folder: Path) -> bool:
    from ct_inertia.scan.slices import SLICE_SUFFIXES

    return any(path.suffix.lower() in SLICE_SUFFIXES for path in folder.iterdir())


def _holds_values(path: Path) -> bool:
    """Return whether a file may hold a measurement: a text of notes has no lines of numbers."""
    if path.suffix.lower() not in TEXT_ENDINGS:
        return path.stat().st_size > 0
    beginning = path.read_bytes()[:_LOOKED_AT].replace(b"\0", b"").decode("latin-1")
    rows = [line for line in beginning.splitlines() if len(_VALUE.findall(line)) > 1]
    return len(rows) > 1


def _is_volume(folder: Path) -> bool:
    """Return whether a folder is recognised as a volume by its content: OME-Zarr, DICOM."""
    from ct_inertia.scan.formats import FORMATS

    return any(entry.matches(folder) for entry in FORMATS[:-1] if entry.matches is not None)


def _is(recognise: Callable[[], object]) -> bool:
    try:
        recognise()
    except (StapeskitError, OSError, ValueError):
        return False
    return True


def new_study(folder: Path, ask: Ask | None = None, *, force: bool = False) -> Path:
    """Write a study.toml next to the files of an ear and return its path.

    Parameters
    ----------
    ask : callable, optional
        Takes a question, returns the answer, empty for "not known"; None: nothing is asked.
    force : bool
        Replace a study.toml of another origin.

    Raises
    ------
    StapeskitError
        The folder has no scan or no vibrometer file, or several and nothing says which; or a
        study.toml of another origin.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise StapeskitError.of("the folder", "an existing folder", folder, "", "Check its name")
    found = look(folder)
    scan = _one("scan", found.scans, folder, ask)
    ldv = _one("vibrometer file", found.measurements, folder, ask)
    answers = {} if ask is None else _answers(ask, scan)
    outputs = Outputs("stapeskit new", folder, [STUDY], [], force)
    with outputs.staged() as stage:
        text = study_text(folder.resolve().name, scan, ldv, found.others, answers)
        (stage / STUDY).write_text(text, encoding="utf-8")
    return folder / STUDY


def _one(what: str, files: list[Path], folder: Path, ask: Ask | None) -> Path:
    if not files:
        step = f"Put the {what} there, or write the study by hand: scan2kd --template"
        raise StapeskitError.of(f"the folder {folder}", f"one with a {what}", "none", "", step)
    usual = [path for path in files if path.name.lower().split(".")[0] in ("scan", "ldv")]
    for chosen in (files, usual):
        if len(chosen) == 1:
            return chosen[0]
    listed = ", ".join(f"{number} {path.name}" for number, path in enumerate(files, 1))
    answer = "" if ask is None else ask(f"Which is the {what}? {listed}: ").strip()
    for number, path in enumerate(files, 1):
        if answer in (str(number), path.name):
            return path
    step = "Move the others away, or name it scan or ldv"
    raise StapeskitError.of(f"the {what}", "one file", answer or listed, "", step)


def _answers(ask: Ask, scan: Path) -> dict[str, Any]:
    """Return what is answered to the questions, as options read it; a wrong answer is asked again."""
    from ct_inertia.options import MassOptions

    options = MassOptions.of(scan=scan)
    answers: dict[str, Any] = {}
    for keys, asked in QUESTIONS.items():
        if keys in (LAYOUT, SPACING) and lacking(options)[0] != keys:
            continue
        question = asked
        while answer := ask(question).strip():
            words = dict(zip(keys, answer.rsplit(maxsplit=len(keys) - 1), strict=False))
            try:
                options = MassOptions.of(scan=scan, **answers, **words)
                answers |= {key: getattr(options, key) for key in keys}
                break
            except StapeskitError as error:
                question = f"{error} {asked}"
    return answers


def lacking(scan: MassOptions) -> tuple[tuple[str, ...], str]:
    """Return the keys of [scan] without which a scan cannot be opened, and the sentence that says so.

    `LAYOUT` for raw voxels, `SPACING` where no file says it; empty where the scan can be opened, or where
    something else is wrong.
    """
    from ct_inertia.ct2mass import check_inputs

    try:
        with scan.as_keys():
            check_inputs(scan)
    except StapeskitError as error:
        if scan.file is not None and scan.raw is None and _is_raw(scan.file):
            return LAYOUT, str(error)
        if any(fault.thing == "the voxel spacing" for fault in error.faults):
            return SPACING, str(error)
    return (), ""


def _is_raw(path: Path) -> bool:
    """Return whether a file holds voxels without a header."""
    from ct_inertia.scan.formats import RAW, format_of

    try:
        return path.is_file() and format_of(path) is RAW
    except StapeskitError:
        return False


def needs(study: Path) -> str:
    """Return what a new study still lacks before it can run, in words; empty where nothing is missing."""
    from pipeline.run import check_study
    from pipeline.study import read_study

    try:
        check_study(read_study(study))
    except StapeskitError as error:
        return str(error)
    return ""


def study_text(
    name: str, scan: Path, ldv: Path, others: Mapping[str, Path], answers: Mapping[str, Any]
) -> str:
    """Return a study of about eleven keys, each with a comment; those that nothing is known of are off."""

    def line(key: str, value: object, comment: str, known: bool = True) -> str:
        return f"{'' if known else '# '}{key} = {toml(value)}  # {comment}"

    def asked(key: str, example: object, comment: str) -> str:
        return line(key, answers.get(key, example), comment, key in answers)

    def files(comments: Mapping[str, str], always: bool) -> list[str]:
        return [
            line(key, others[key].name if key in others else f"{key}.csv", comment, key in others)
            for key, comment in comments.items()
            if always or key in others
        ]

    found_in_scan = {"labels": "a cut made elsewhere", "landmarks": "landmarks in the scan",
                     "plate_fiducials": "plate fiducials in the scan"}  # fmt: skip
    places = {"points": "positions of the points", "fiducials": "ties vibrometer and plate"}
    bone = "bone" if "density_kg_m3" in answers else "ASSUMED while this line is a comment: state your own"
    layout = {"shape": ([512, 512, 600], "voxels along x, y, z"), "dtype": ("uint16", "type of a voxel")}
    tables = {
        "study": [line("name", name, "in reports"), line("notes", "", "incus, cochlea, storage ...")],
        "scan": [
            line("file", scan.name, "volume, folder of slices, or mesh"),
            *(asked(key, *words) for key, words in layout.items() if _is_raw(scan)),
            asked("spacing_mm", 0.02, "voxel size, where the scan does not carry it"),
            asked("density_kg_m3", str(ASSUMED_DENSITY), bone),
            asked("side", "left", "names z superior or inferior"),
            asked("anterior", [-1.0, 0.0, 0.0], "towards anterior in scan axes; its sign counts"),
            *files(found_in_scan, always=False),
        ],
        "ldv": [line("file", ldv.name, "vibrometer file"), *files(places, always=True)],
        "fit": [line("dof", ["y", "alpha", "gamma"], "degrees of freedom of K and D")],
    }
    head = "# One ear. Run it with: scan2kd study.toml. All keys: scan2kd --template"
    return head + "".join(f"\n\n[{table}]\n" + "\n".join(lines) for table, lines in tables.items()) + "\n"
