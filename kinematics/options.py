"""The options of ``points2dof``, each declared once: command line, study file and Python."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from stapeskit.dof import DOF_NAMES
from stapeskit.faults import Fault
from stapeskit.option_types import (
    Count,
    DofList,
    Flag,
    Kind,
    Percent,
    Positive,
    ReadFile,
    ReadFiles,
    Text,
    Words,
    entries,
    existing,
    output_file,
    path,
    require,
)
from stapeskit.options import Opt, Options, Rule

NONE = "none"
"""Word that turns a file off which would be looked for beside the measurement."""

EXPORTS = ("mat",)
"""What ``--export`` writes beside the table of the motion: X.mat for MATLAB and Octave."""

_TIES = "from the vibrometer to the footplate"
_LASERS = "how well the lasers agree: shared errors of the motion, of K and of D"
_FILES = "what files do not say themselves"
_SERIES = "time series"


def _file_or_none(value: Any) -> Path | str:
    found = path(value)
    return NONE if found.name == NONE and not found.exists() else existing(found)


def _rules(value: Any) -> tuple[str, ...]:
    """Return rules ``NAME=ITEMS`` from texts or from a table of names."""
    if isinstance(value, Mapping):
        value = [f"{name}={','.join(entries(items))}" for name, items in value.items()]
    found = tuple(entries(value))
    require(all(isinstance(rule, str) and 0 < rule.find("=") < len(rule.strip()) - 1 for rule in found))
    return found


def _texts(value: Any) -> tuple[str, ...]:
    found = tuple(entries(value))
    require(all(isinstance(text, str) and text.strip() for text in found))
    return found


FileOrNone = Annotated[
    Path | str,
    Kind(_file_or_none, "an existing file, or none", "FILE|none", "Check its name and folder", is_path=True),
]
Rules = Annotated[tuple[str, ...], Kind(_rules, "NAME=ITEMS", "NAME=ITEMS")]
Texts = Annotated[tuple[str, ...], Kind(_texts, "BODY:POINT or BODY:POINT:BEAM", "CHANNEL")]
CsvFile = Annotated[Path, output_file(".csv")]


def _rule(broken: Callable[[Any], Any], thing: str, expected: str, got: str, step: str) -> Rule:
    return Rule(broken, Fault(thing, expected, got, "", step))


class MotionOptions(Options):
    """What is measured, how it is tied to the footplate, and how the motion is fitted: ``[ldv]``."""

    table: ClassVar[str] = "ldv"
    rules: ClassVar[tuple[Rule, ...]] = (
        _rule(lambda v: not v.file, "LDV", "given", "nothing", "points2dof --help lists the formats"),
        _rule(
            lambda v: v.frame and isinstance(v.fiducials, Path),
            "--frame", "left out with --fiducials, which name their frame themselves", "both",
            "Write the frame into the column frame of the fiducials file",
        ),
        _rule(
            lambda v: v.correct and v.calibrate,
            "--correct", "left out with --calibrate, which takes faults for errors of the geometry", "both",
            "Correct the file by what --correct reports, and calibrate then",
        ),
    )  # fmt: skip

    file: Annotated[
        ReadFiles | tuple[()],
        Opt(
            "vibrometer file or folder; several are parts of one measurement, or runs of the same points",
            example="ldv.csv",
            name="ldv",
            positional=True,
            repeats=True,
            recommended=True,
        ),
    ] = ()
    points: Annotated[
        FileOrNone | None,
        Opt(
            "bodies and positions: body, point, x_mm, y_mm, z_mm [, sd_mm]; default points.csv beside LDV",
            example="points.csv",
            recommended=True,
        ),
    ] = None
    dof: Annotated[DofList, Opt("degrees of freedom of each body", example="all")] = DOF_NAMES
    reference: Annotated[Text, Opt("responses per unit of this motion, BODY:DOF", example="base:y")] = ""
    robust: Annotated[Literal["none", "huber", "t4"], Opt("resist outliers")] = "none"
    leave_out: Annotated[
        Texts,
        Opt(
            "leave out a point, or one of its beams (x, -z ... or X,Y,Z as on the page); may be repeated",
            example=["stapes:3", "base:7:z"],
            repeats=True,
        ),
    ] = ()
    correct: Annotated[Flag, Opt("correct faults by their estimates, or leave their channels out")] = False

    fiducials: Annotated[
        FileOrNone | None,
        Opt(
            "marks that tie vibrometer and scan: name, x_mm, y_mm, z_mm, x_ref_mm, y_ref_mm, z_ref_mm [, "
            "frame] [, sd_mm]; default fiducials.csv beside LDV",
            _TIES,
            "fiducials.csv",
            recommended=True,
        ),
    ] = None
    frame: Annotated[
        Literal["footplate", "plate", "scan"] | None,
        Opt("frame of positions and directions without fiducials; default footplate", _TIES, "footplate"),
    ] = None
    mirror: Annotated[
        Literal["x", "y", "z"] | None,
        Opt("reverse this axis of left-handed coordinates", _TIES, "x"),
    ] = None

    calibrate: Annotated[
        Flag,
        Kind,
        Opt("estimate axes, laser directions, gains and positions with the motion, within their sd", _LASERS),
    ] = False
    gain_sd_percent: Annotated[
        Percent,
        Opt(
            "sd of gains of lasers, percent, with 0.5 degrees of phase and 1 us for each; 0: exact",
            _LASERS,
        ),
    ] = 1.0

    body: Annotated[
        Rules,
        Opt(
            "points of a body: stapes=1-10,12 or base=FILE or base=FILE:1-10; may be repeated",
            _FILES,
            {"stapes": "1-10", "base": "11-19"},
            repeats=True,
        ),
    ] = ()
    run: Annotated[
        Rules,
        Opt(
            "the excitation that a file belongs to, push=FILE; may be repeated",
            _FILES,
            {"push": "first.uff", "tilt": "second.uff"},
            repeats=True,
        ),
    ] = ()
    beam: Annotated[Text, Opt("direction towards the laser head: x, -z ... or X,Y,Z", _FILES, "z")] = ""
    amplitude: Annotated[
        Literal["peak", "rms"] | None,
        Opt("what amplitudes are; default peak, with a warning", _FILES, "peak"),
    ] = None
    length_unit: Annotated[
        Literal["m", "mm", "um"] | None, Opt("unit of positions; default m, with a warning", _FILES, "mm")
    ] = None
    n_avg: Annotated[
        Positive | None, Opt("averages behind each value: with coherence they give its noise", _FILES, 20)
    ] = None

    channels: Annotated[
        ReadFile | None,
        Opt(
            "what each channel of time series is: channel, role, body, point, dir, unit (CSV)",
            _SERIES,
            "channels.csv",
        ),
    ] = None
    averages: Annotated[Count, Opt("segments of a record of random excitation", _SERIES)] = 30
    period_s: Annotated[
        Positive | None, Opt("period of a periodic excitation, s", _SERIES, 0.2, name="period")
    ] = None

    @property
    def points_file(self) -> Path | None:
        """The points file, None where there is none."""
        return self.points if isinstance(self.points, Path) else None

    @property
    def fiducials_file(self) -> Path | None:
        """The fiducials file, None where there is none."""
        return self.fiducials if isinstance(self.fiducials, Path) else None

    @property
    def source_frame(self) -> str:
        """Frame of positions and directions in the files."""
        return "vibrometer" if self.fiducials_file else self.frame or "footplate"

    @property
    def laser_sd(self) -> dict[str, float]:
        """How well the lasers agree, by kind of error: 1, rad and s."""
        from kinematics.joint.expected import LASER_SD

        return {kind: self.gain_sd_percent * sd for kind, sd in LASER_SD.items()}

    def inputs(self) -> dict[str, Path]:
        """Return every file that is named, by its role."""
        named = {
            "points": self.points_file,
            "fiducials": self.fiducials_file,
            "channels": self.channels,
        }
        files = {"ldv" if not number else f"ldv {number + 1}": path for number, path in enumerate(self.file)}
        return files | {role: path for role, path in named.items() if path is not None}

    def parameters(self) -> dict[str, Any]:
        """Return what differs from the defaults, for the provenance; files are among its inputs."""
        files = {"file", "points", "fiducials", "channels"}
        return {key: value for key, value in self.given().items() if key not in files}


class MotionFiles(Options):
    """What the command reads besides, and what it writes."""

    mass: Annotated[
        FileOrNone | None,
        Opt("mass.json of ct2mass; default mass.json or *_mass/mass.json beside LDV", example="mass.json"),
    ] = None
    out: Annotated[CsvFile, Opt("table of the motion; X.h5, X.channels.csv and X.html beside it")] = Path(
        "dof.csv"
    )
    export: Annotated[Words, Opt(f"further files: {', '.join(EXPORTS)}", example=["mat"])] = ()
    force: Annotated[Flag, Opt("replace files that this command did not write")] = False
    as_json: Annotated[Flag, Opt("print the whole result as JSON", name="json")] = False
    quiet: Annotated[Flag, Opt("print nothing but errors")] = False
    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(
            lambda v: set(v.export) - set(EXPORTS),
            lambda v: Fault("--export", f"out of {', '.join(EXPORTS)}", ", ".join(v.export)),
        ),
    )
