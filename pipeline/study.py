"""The study file: what one ear's scan, vibrometer table and fit are, checked all at once."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline import fields
from pipeline.errors import PipelineError
from stapeskit.faults import Fault, raise_all

_RAW = ("shape", "dtype", "byte_order", "header_bytes")
_MASSES = ("density_kg_m3", "mass_mg", "calibration")


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class About(_Table):
    """``[study]``: what this ear is, in words."""

    name: fields.Text = ""
    notes: fields.Text = ""


class Scan(_Table):
    """``[scan]``: the options of `ct2mass`."""

    file: fields.File | None = None
    spacing_mm: fields.Spacing | None = None
    shape: fields.Voxels | None = None
    dtype: fields.VoxelType | None = None
    byte_order: fields.ByteOrder | None = None
    header_bytes: fields.Whole | None = None
    density_kg_m3: fields.ValueWithSd | None = None
    mass_mg: fields.ValueWithSd | None = None
    calibration: fields.File | None = None
    labels: fields.File | None = None
    stapes_label: fields.Label = 1
    plate_label: fields.Label = 2
    landmarks: fields.File | None = None
    plate_fiducials: fields.File | None = None
    side: fields.Side | None = None
    anterior: fields.Direction | None = None
    threshold: fields.Number | None = None
    seed_mm: fields.Vector | None = None
    box_mm: fields.Box | None = None
    mirror: fields.Axis | None = None
    nan_as_air: fields.Flag = False
    add_mass: fields.Masses = ()
    voxel_size_sd_percent: fields.Percent | None = None


class Ldv(_Table):
    """``[ldv]``: the options of `points2dof`."""

    file: fields.Files
    points: fields.File | None = None
    fiducials: fields.File | None = None
    body: fields.Named = ()
    run: fields.Named = ()
    beam: fields.Beam = ""
    amplitude: fields.Amplitude = ""
    length_unit: fields.LengthUnit = ""
    n_avg: fields.Number | None = None
    mapping: fields.File | None = None
    channels: fields.File | None = None
    reference_channel: fields.Text | None = None
    frf: fields.Text | None = None
    window: fields.Text | None = None
    overlap: fields.Number | None = None
    averages: fields.Whole | None = None
    resolution_hz: fields.Number | None = None
    period_s: fields.Number | None = None
    skip_periods: fields.Whole | None = None
    steps: fields.File | None = None
    settle: fields.Number | None = None
    frf_band_hz: fields.Range | None = None
    frame: fields.Frame | None = None
    dof: fields.Dof = ("x", "y", "z", "alpha", "beta", "gamma")
    reference: fields.Text = ""
    reference_noise: fields.Number = 0.0
    robust: fields.RobustPoints = "none"
    repeats: fields.Repeats = "pool"
    mirror: fields.Axis | None = None
    mirror_points: fields.Axis | None = None
    plate_points: fields.File | None = None
    bone_points: fields.File | None = None
    calibrate: fields.Flag = False
    axes_sd_deg: fields.Number | None = None
    beam_sd_deg: fields.Number | None = None
    gain_sd_percent: fields.Number | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """The vibrometer files, one or several."""
        return self.file if isinstance(self.file, tuple) else (self.file,)


class Fit(_Table):
    """``[fit]``: the options of `dof2kd`."""

    dof: fields.Dof = ("y", "alpha", "gamma")
    structure: fields.Text = "stapes"
    base: fields.Text = "base"
    estimator: fields.Estimator = "ml"
    robust: fields.RobustFit = "none"
    damping: fields.Damping = "viscous"
    inplane: fields.Inplane = "auto"
    band_hz: fields.Range | None = None
    exclude_hz: fields.Ranges = ()
    bands: fields.Bands = 5
    monte_carlo: fields.Refits = 0
    constraint: fields.Constraint = "eigenvalues"
    lower: fields.Bounds = Field(default_factory=dict)
    upper: fields.Bounds = Field(default_factory=dict)


class Study(_Table):
    """One study file."""

    study: About = About()
    scan: Scan
    ldv: Ldv
    fit: Fit = Fit()


def read_study(path: Path) -> Study:
    """Read and check a study file.

    Raises
    ------
    PipelineError
        The file is missing or no TOML, a key is unknown (the nearest valid one is named), a value is not what
        it must be, a file that it names does not exist, or choices contradict each other: all in one message.
    """
    path = Path(path)
    if not path.is_file():
        raise PipelineError(
            Fault(
                "the study file",
                "an existing TOML file",
                path,
                next_step="scan2kd --template prints one to start from",
            )
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as fault:
        raise PipelineError(Fault("the study file", "UTF-8 text", fault, path.name)) from fault
    return parse_study(text, path.absolute().parent, path.name)


def parse_study(text: str, folder: Path, name: str = "study.toml", check_files: bool = True) -> Study:
    """Check the text of a study file; see read_study.

    Parameters
    ----------
    folder : Path
        Where relative paths start.
    name : str
        The file's name in messages.
    check_files : bool
        Whether the files named must exist.
    """
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        raise PipelineError(
            Fault("the study file", "valid TOML", fault, name, "Texts and paths stand in quotes")
        ) from fault
    faults = []
    study: Study | None = None
    try:
        study = Study.model_validate(tables, context={"folder": folder, "check_files": check_files})
    except ValidationError as found:
        faults += [_fault(dict(error), name) for error in found.errors(include_url=False)]
    faults += _contradictions(tables, name)
    raise_all(PipelineError, faults)
    if study is None:
        raise PipelineError(Fault(name, "readable as a study file", "something else"))
    return study


def _fault(error: dict[str, Any], name: str) -> Fault:
    """Turn one finding of pydantic into a sentence that names table and key."""
    place = tuple(str(part) for part in error["loc"])
    key = ".".join(place)
    thing = f"the table [{key}]" if len(place) == 1 else key
    if error["type"] == "extra_forbidden":
        return _unknown(place, name)
    if error["type"] == "missing":
        return Fault(thing, "given", "nothing", name, "scan2kd --template shows a whole study file")
    if error["type"] == fields.EXPECTED:
        told = error["ctx"]
        return Fault(thing, told["expected"], _shown(error["input"]), name, told["next_step"])
    return Fault(thing, "a table of keys", _shown(error["input"]), name)


def _unknown(place: tuple[str, ...], name: str) -> Fault:
    """Name the nearest valid key, in its own table first."""
    tables: dict[str, type[BaseModel]] = {"study": About, "scan": Scan, "ldv": Ldv, "fit": Fit}
    if len(place) == 1:
        known = [f"[{table}]" for table in tables]
        homes = [
            f"{place[0]} in [{table}]" for table, model in tables.items() if place[0] in model.model_fields
        ]
        near = homes or difflib.get_close_matches(f"[{place[0]}]", known, 1)
        hint = f"Did you mean {near[0]}?" if near else ""
        return Fault("a table", f"one of {', '.join(known)}", f"[{place[0]}]", name, hint)
    own = list(tables[place[0]].model_fields)
    near = difflib.get_close_matches(place[1], own, 1, cutoff=0.5)
    if not near:
        near = [
            f"{table}.{key}"
            for table, model in tables.items()
            for key in model.model_fields
            if key == place[1]
        ]
    hint = f"Did you mean {near[0]}?" if near else f"Its keys are {', '.join(own)}"
    return Fault(f"a key of [{place[0]}]", "a known one", place[1], name, hint)


def _contradictions(tables: dict[str, Any], name: str) -> list[Fault]:
    """List choices that do not go together."""
    faults = []
    scan, ldv, fit = (
        table if isinstance(table := tables.get(key, {}), dict) else {} for key in ("scan", "ldv", "fit")
    )
    masses = [key for key in _MASSES if key in scan]
    if "scan" in tables and not masses:
        faults.append(
            Fault(
                "the mass of the stapes in [scan]",
                "given by at least one of density_kg_m3, mass_mg and calibration",
                "none of them",
                name,
                "Bone has 1400 to 2200 kg/m3",
            )
        )
    if "scan" in tables and "file" not in scan and "labels" not in scan:
        faults.append(Fault("scan.file", "given, or scan.labels", "neither", name))
    raw = [key for key in _RAW if key in scan]
    faults += [
        Fault(
            f"scan.{key}",
            f"given with scan.{raw[0]}, which speaks of raw voxels",
            "nothing",
            name,
            "Give shape = [NX, NY, NZ] and dtype for a file without a header, or none of the four keys",
        )
        for key in _RAW[:2]
        if raw and key not in scan
    ]
    if "fiducials" in ldv and "frame" in ldv:
        faults.append(
            Fault(
                "ldv.frame",
                "left out beside ldv.fiducials, which name their frame themselves",
                ldv["frame"],
                name,
            )
        )
    if "plate_points" in ldv and "frame" in ldv:
        expected = "left out beside ldv.plate_points, which tie the vibrometer to the scan"
        faults.append(Fault("ldv.frame", expected, ldv["frame"], name))
    if not ldv.get("calibrate", False):
        faults += [
            Fault(f"ldv.{key}", "given with ldv.calibrate = true only", ldv[key], name)
            for key in ("axes_sd_deg", "beam_sd_deg", "gain_sd_percent")
            if key in ldv
        ]
    if fit.get("robust", "none") != "none" and fit.get("estimator", "ml") != "ml":
        faults.append(Fault("fit.robust", "none unless fit.estimator is ml", fit["robust"], name))
    if ("lower" in fit or "upper" in fit) and fit.get("estimator", "ml") != "constrained":
        faults.append(
            Fault(
                "fit.lower and fit.upper",
                "left out unless fit.estimator is constrained",
                fit.get("estimator", "ml"),
                name,
            )
        )
    return faults


def _shown(value: object) -> str:
    """Show a value as it stands in the file, shortened."""
    text = repr(value) if not isinstance(value, str) else f'"{value}"'
    return text if len(text) <= 80 else f"{text[:77]}..."
