"""The options of ``points2dof``; choices of the fit also in fit_options.py, files in measure_motion.py."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from legacy.kinematics.errors import KinematicsError
from legacy.stapeskit.option_declaration import option
from legacy.stapeskit.option_kinds import (
    BEAM,
    BODIES,
    CHANNELS,
    DOF,
    FLAG,
    RANGE,
    RUNS,
    TEXT,
    at_least,
    choice,
    file,
    files,
    number,
    output,
    summaries,
)
from legacy.stapeskit.option_rules import Rule, excludes, needs
from legacy.stapeskit.options import OptionTable, declared

AXES = ("x", "y", "z")
ROBUST = ("none", "huber", "t4")
REPEATS = ("pool", "separate")
FRF_ESTIMATORS = {
    "h1": "noise in the responses",
    "h2": "noise in the reference",
    "hv": "in both",
    "lpm": "local polynomials, without windows",
}
LOCAL = "lpm"
_USUAL_SERIES = {
    "frf": "h1", "window": "hann", "overlap": 0.5, "averages": 30, "skip_periods": 1, "settle": 0.2,
    "reference_channel": "",
}  # fmt: skip
WINDOWS = ("none", "hann", "hamming", "blackman", "flattop")
_SD = number("a number from 0 to 20 (degrees, percent of gain)", lambda value: 0.0 <= value <= 20.0)
_POSITIVE = number("a positive number", lambda value: value > 0.0)
_SERIES = "time series (with --channels; universal files need none)"
_FILES = "what files do not say themselves"
_TIES = "from the vibrometer to the footplate"
_GEOMETRY = "geometry as an unknown"
_LASERS = "how well the lasers agree: shared errors of the motion, of K and of D"


@dataclass(frozen=True)
class _MeasurementOptions(OptionTable):
    """What is measured, how it is tied to the footplate, and how the motion is fitted."""

    table = "ldv"
    title = "points2dof"
    error = KinematicsError

    ldv: tuple[Path, ...] = option(
        files("vibrometer file or folder"),
        "vibrometer file or folder, of a format that points2dof --help lists; several are parts of one "
        "measurement, or runs when they measure the same points",
        (),
        key="file",
        metavar="LDV",
        positional=True,
        required=True,
        example="ldv.csv",
    )
    points: Path | None = option(
        file("points file"),
        "bodies and positions of the points: body, point, x_mm, y_mm, z_mm [, sd_mm] (CSV)",
        example="points.csv",
    )
    dof: tuple[str, ...] = option(DOF, "degrees of freedom of each body", "all")
    reference: str = option(
        TEXT, "responses per unit of this motion", "", metavar="BODY:DOF", example="base:y"
    )
    reference_noise: float = option(
        number("from 0 to below 1", lambda value: 0.0 <= value < 1.0),
        "relative noise (sd of the real part) of the signal that all readings refer to",
        0.0,
        metavar="S",
    )
    robust: str = option(choice(*ROBUST), "resist outliers", "none")
    repeats: str = option(
        choice(*REPEATS),
        "repeats and levels of a run: pool them after comparing them, or keep them as runs",
        "pool",
    )
    leave_out: tuple[str, ...] = option(
        CHANNELS,
        "leave a point out, or one of its beams (x, -z ... or X,Y,Z); once for each",
        (),
        example=["stapes:3", "base:7:z"],
    )
    correct: bool = option(
        FLAG,
        "correct the faults that are identified by their estimates, whose uncertainty goes into the motion, "
        "and leave out channels whose fault has no size that the data determine",
        False,
        example=True,
    )
    fiducials: Path | None = option(
        file("fiducials file"),
        "points that tie vibrometer and scan: name, x_mm, y_mm, z_mm, x_ref_mm, y_ref_mm, z_ref_mm "
        "[, frame] [, sd_mm] (CSV)",
        group=_TIES,
        example="fiducials.csv",
        recommended=True,
    )
    frame: str | None = option(
        choice("footplate", "plate", "scan"),
        "frame of positions and directions when there are no fiducials (footplate)",
        group=_TIES,
        example="footplate",
    )
    mirror: str | None = option(
        choice(*AXES),
        "turn this axis of left-handed scanner coordinates round",
        group=_TIES,
        example="x",
    )
    mirror_points: str | None = option(
        choice(*AXES),
        "turn this axis of all positions round, not of the beams: for left-handed coordinates beside "
        "right-handed directions",
        group=_TIES,
        example="x",
    )
    plate_points: Path | None = option(
        file("file of surface points"),
        "points measured on the plate, laid on its surface in the scan, alone or with {fiducials} as the "
        "first guess: [name,] x_mm, y_mm, z_mm [, sd_mm] (CSV)",
        group=_TIES,
        example="plate_points.csv",
    )
    bone_points: Path | None = option(
        file("file of surface points"),
        "points measured on the bone: did the sample move since the scan?",
        group=_TIES,
        example="bone_points.csv",
    )
    calibrate: bool = option(
        FLAG,
        "estimate axes, laser directions and point positions together with the motion, within their sd",
        False,
        group=_GEOMETRY,
        example=True,
    )
    axes_sd_deg: float | None = option(
        _SD,
        "sd of the turn between beams and positions, degrees (1)",
        unit="deg",
        metavar="DEG",
        group=_GEOMETRY,
        example=1.0,
    )
    beam_sd_deg: float | None = option(
        _SD,
        "sd of the direction of each laser, degrees (0.5)",
        unit="deg",
        metavar="DEG",
        group=_GEOMETRY,
        example=0.5,
    )
    gain_sd_percent: float = option(
        _SD,
        "sd of the gain of each laser against the others, percent (0: exact)",
        1.0,
        unit="percent",
        metavar="PERCENT",
        group=_LASERS,
        example=1.0,
    )
    phase_sd_deg: float = option(
        _SD,
        "sd of the phase of each laser against the others, degrees (0: exact)",
        0.5,
        unit="deg",
        metavar="DEG",
        group=_LASERS,
        example=0.5,
    )
    delay_sd_us: float = option(
        number("a number from 0 to 1000 (microseconds)", lambda value: 0.0 <= value <= 1000.0),
        "sd of the delay of each laser against the others, microseconds (0: exact)",
        1.0,
        unit="us",
        metavar="US",
        group=_LASERS,
        example=1.0,
    )
    body: tuple[str, ...] = option(
        BODIES,
        "points of a body: 1-10,12 or FILE or FILE:1-10; once for each body",
        (),
        group=_FILES,
        example={"stapes": "1-10", "base": "11-19"},
    )
    run: tuple[str, ...] = option(
        RUNS,
        "the excitation that a file belongs to; once for each file",
        (),
        group=_FILES,
        example={"push": "first.uff", "tilt": "second.uff"},
    )
    beam: str | None = option(
        BEAM, "direction towards the laser head: x, -z ... or X,Y,Z", group=_FILES, example="z"
    )
    amplitude: str | None = option(
        choice("peak", "rms"),
        "what amplitudes are (peak, with a warning)",
        group=_FILES,
        example="peak",
    )
    length_unit: str | None = option(
        choice("m", "mm", "um"), "unit of positions (m, with a warning)", group=_FILES, example="mm"
    )
    n_avg: float | None = option(
        number("a number of averages, 1 or more", lambda value: value >= 1.0),
        "averages behind each value: with coherence they give its noise",
        metavar="N",
        group=_FILES,
        example=20,
    )
    mapping: Path | None = option(
        file("TOML file"),
        "which variable of a MATLAB or HDF5 file, or column of a wide table, is what (FILE.mat.toml, or by "
        "their names)",
        metavar="FILE.toml",
        group=_FILES,
        example="names.toml",
    )


@dataclass(frozen=True)
class _SeriesTable(OptionTable):
    """How time series are turned into frequency responses; None is not given.

    Raises
    ------
    KinematicsError
        A value out of its range or options that exclude each other; all together.
    """

    table = "ldv"
    title = "points2dof"
    error = KinematicsError
    rules: ClassVar[tuple[Rule, ...]] = (excludes("steps", "period", "an excitation is periodic or stepped"),)

    channels: Path | None = option(
        file("channel table"),
        "which column is what beam at what point: channel, role, body, point, dir, unit (CSV)",
        group=_SERIES,
        example="channels.csv",
    )
    reference_channel: str = option(
        TEXT,
        "the reference among several: a channel, or NODE+DIR",
        metavar="NAME",
        group=_SERIES,
        example="force",
    )
    frf: str = option(
        choice(*FRF_ESTIMATORS),
        f"estimator of responses to random excitation (h1); {summaries(FRF_ESTIMATORS)}",
        group=_SERIES,
        example="h1",
    )
    window: str = option(
        choice(*WINDOWS), "window of the segments (hann)", metavar="NAME", group=_SERIES, example="hann"
    )
    overlap: float = option(
        number("between 0 and 0.95", lambda value: 0.0 <= value <= 0.95),
        "share in which neighbouring segments overlap (0.5)",
        metavar="SHARE",
        group=_SERIES,
        example=0.5,
    )
    averages: int = option(at_least(3), "segments in a record (30)", group=_SERIES, example=30)
    resolution_hz: float | None = option(
        _POSITIVE,
        "spacing of lines, instead of {averages}",
        unit="hz",
        metavar="HZ",
        group=_SERIES,
        example=5.0,
    )
    period_s: float | None = option(
        _POSITIVE,
        "period of a periodic excitation",
        unit="s",
        metavar="S",
        group=_SERIES,
        example=0.2,
    )
    skip_periods: int = option(at_least(0), "periods left out at the start (1)", group=_SERIES, example=1)
    steps: Path | None = option(
        file("table of steps"),
        "stepped sine: start_s, stop_s, freq_hz (CSV)",
        group=_SERIES,
        example="steps.csv",
    )
    settle: float = option(
        number("from 0 to 0.9", lambda value: 0.0 <= value <= 0.9),
        "share of each step left out at its start (0.2)",
        metavar="SHARE",
        group=_SERIES,
        example=0.2,
    )
    frf_band_hz: tuple[float, float] | None = option(
        RANGE, "frequencies to keep, Hz", unit="hz", group=_SERIES, example=[400, 5000]
    )


@dataclass(frozen=True)
class SeriesOptions(_SeriesTable):
    """How time series are turned into frequency responses; what is not given has its usual value."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, value in _USUAL_SERIES.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)


@dataclass(frozen=True)
class LdvOptions(_SeriesTable, _MeasurementOptions):
    """What ``points2dof`` reads and how it fits; every field is an option and a key of ``[ldv]``.

    Raises
    ------
    KinematicsError
        A value is unfit or options contradict each other; all together.
    """

    rules: ClassVar[tuple[Rule, ...]] = (
        *_SeriesTable.rules,
        excludes(
            "frame",
            "fiducials",
            "which name their frame themselves",
            "Put the frame into the column frame of the fiducials file",
        ),
        excludes("frame", "plate_points", "which tie the vibrometer to the scan"),
        *(needs(name, "calibrate") for name in ("axes_sd", "beam_sd")),
        excludes(
            "correct",
            "calibrate",
            "which takes faults for errors of the geometry",
            "Correct the file by what {correct} reports, and calibrate then",
        ),
    )

    @property
    def files(self) -> tuple[Path, ...]:
        """The vibrometer files and folders."""
        return self.ldv

    @property
    def series_given(self) -> dict[str, Any]:
        """The options of time series that are given, by field."""
        values = {option.field: getattr(self, option.field) for option in declared(_SeriesTable)}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class PointsFiles(OptionTable):
    """Other files that the command reads, and the files that it writes."""

    title = "points2dof"
    rules = (
        *(
            needs(name, "mass", "mass.json, whose folder holds the surfaces of the scan")
            for name in ("plate_points", "bone_points")
        ),
        Rule(
            lambda v: v.frame in ("plate", "scan") and not v.mass,
            "{frame}",
            "footplate, or given with {mass} mass.json",
            next_step="Add {mass}",
            shows="frame",
        ),
    )
    error = KinematicsError

    mass: Path | None = option(
        file("mass.json", "Run ct2mass to make one"),
        "frames and mass matrix, of ct2mass",
        metavar="mass.json",
        example="mass.json",
    )
    out: Path = option(output(".csv"), "table of the motion", "dof.csv")
    force: bool = option(FLAG, "replace outputs that this command did not write, or that were edited", False)
