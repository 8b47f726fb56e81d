"""The options of ``ct2mass``, each declared once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.export_formats import EXPORTS
from legacy.stapeskit.option_declaration import option
from legacy.stapeskit.option_kinds import (
    BALLS,
    BOX,
    DIRECTION,
    FLAG,
    FOLDER,
    LENGTHS,
    MASSES,
    NUMBER,
    POINT,
    SPACING,
    VALUE_OR_ZERO_WITH_SD,
    VALUE_WITH_SD,
    VOXEL_TYPE,
    VOXELS,
    at_least,
    choice,
    file,
    number,
    several,
    summaries,
)
from legacy.stapeskit.option_rules import Rule, Values, excludes, needs
from legacy.stapeskit.option_values import WithSd
from legacy.stapeskit.options import OptionTable

if TYPE_CHECKING:
    from legacy.ct_inertia.readers.raw_layout import RawLayout

# kg/m3, refused outside. Chosen by judgement: it holds every bone (published_sizes.py: 1300 to 2200) and no
# density in a wrong unit, which is off by a factor of 1000.
PLAUSIBLE_DENSITY = (500.0, 4000.0)
_MASS = "mass (at least one; measured mass leads, then calibration, then density)"
_READING = "reading"
_RAW = "raw voxels without a header"
_FINDING = "finding the stapes"
_FRAMES = "frames"
_OUTPUT = "output"
# Voxels in which a stapes of 3 mm would have 30 000 voxels a side, or less than one.
_SPACING_MM = (1e-4, 3.0)
# Thinner than a cell: a thickness in mm. Mucosa of the middle ear has 20 to 50 um.
_LEAST_COAT_UM = 1.0


def _plausible_spacing(spacing_mm: tuple[float, ...]) -> bool:
    """Return whether voxel sizes can be meant in mm."""
    return _SPACING_MM[0] <= min(spacing_mm) and max(spacing_mm) <= _SPACING_MM[1]


def _needs_to_be_known(name: str) -> Rule:
    """Return the rule that a value is larger than its standard deviation."""

    def breaks(values: Values) -> bool:
        value: WithSd | None = getattr(values, name)
        return value is not None and value[1] is not None and value[1] >= value[0]

    thing, step = f"the standard deviation of {{{name}}}", "Weigh the stapes, or leave this value out"
    return Rule(breaks, thing, "smaller than its value", next_step=step, shows=name)


def _is_of_bone(density_kg_m3: float) -> bool:
    return PLAUSIBLE_DENSITY[0] <= density_kg_m3 <= PLAUSIBLE_DENSITY[1]


def is_mesh(scan: Path | None) -> bool:
    """Return whether an input is a surface mesh, by its suffix."""
    from legacy.ct_inertia.surface.surface import SURFACE_SUFFIXES

    return scan is not None and Path(scan).suffix.lower() in SURFACE_SUFFIXES


def _refuse_with_mesh(name: str) -> Rule:
    """Return the rule that an option on grey values or voxels is not given with a surface mesh."""

    def breaks(values: Values) -> bool:
        return values.has(name) and is_mesh(values.scan)

    expected = "left out when the input is a surface mesh"
    return Rule(breaks, f"{{{name}}}", expected, next_step="It is about grey values or voxels", shows=name)


def _refuse_with_labels(name: str) -> Rule:
    """Return the rule that labels exclude options which seek the stapes."""
    rule = excludes(name, "labels", "which say where the stapes is", f"Leave out {{{name}}} or {{labels}}")
    return Rule(
        lambda v: rule.breaks(v) and not is_mesh(v.scan), rule.thing, rule.expected, "", rule.next_step, name
    )


def _half_a_layout(name: str) -> Rule:
    """Return the rule that the layout of raw voxels is given whole."""
    return Rule(
        lambda v: v.given("shape", "dtype", "byte_order", "header_bytes") and not v.has(name),
        f"{{{name}}}",
        "given with the other options of raw voxels",
        "none",
        "Give {shape} and {dtype} for a file without a header, or none of these options",
    )


@dataclass(frozen=True)
class MassOptions(OptionTable):
    """What ``ct2mass`` measures and how; every field is an option and a key of ``[scan]``.

    Raises
    ------
    CtInertiaError
        Values are unfit, one is missing, or they contradict each other; all together.
    """

    table = "scan"
    title = "ct2mass"
    error = CtInertiaError
    rules = (
        Rule(lambda v: not v.scan and not v.labels, "{scan}", "given, or {labels} alone", "neither"),
        Rule(
            lambda v: not v.given("density", "mass_mg", "calibration"),
            "the mass of the stapes",
            "given by at least one of {density}, {mass_mg} and {calibration}",
            "none of them",
            "Bone has 1400 to 2200 kg/m3",
        ),
        Rule(
            lambda v: v.density is not None and not _is_of_bone(v.density[0]),
            "{density}",
            f"between {PLAUSIBLE_DENSITY[0]:g} and {PLAUSIBLE_DENSITY[1]:g} kg/m3",
            next_step="Bone has 1400 to 2200 kg/m3; 1 g/cm3 is 1000 kg/m3",
            shows="density",
        ),
        _needs_to_be_known("density"),
        _needs_to_be_known("mass_mg"),
        Rule(
            lambda v: v.spacing_mm is not None and not _plausible_spacing(v.spacing_mm),
            "{spacing}",
            f"the voxel size in mm, {_SPACING_MM[0]:g} to {_SPACING_MM[1]:g}",
            next_step="Divide a size in um by 1000; multiply a size in m by 1000",
            shows="spacing",
        ),
        Rule(
            lambda v: v.coat_um is not None and 0.0 < v.coat_um[0] < _LEAST_COAT_UM,
            "{coat}",
            f"0, or a thickness of at least {_LEAST_COAT_UM:g} um",
            next_step="Multiply a thickness in mm by 1000",
            shows="coat_um",
        ),
        *(_half_a_layout(name) for name in ("shape", "dtype")),
        *(needs(name, "labels", "whose numbers it names") for name in ("stapes_label", "plate_label")),
        *(needs(name, "scan", "whose voxels it measures") for name in ("scale_length", "scale_ball")),
        needs("coat", "scan", "whose grey values show it"),
        needs("coat_grey", "coat"),
        Rule(
            lambda v: v.coat_grey is not None and v.coat_grey[0] >= 1.0,
            "{coat_grey}",
            "a share of the grey value of bone, below 1",
            next_step="Mucosa has 0.1 to 0.2",
            shows="coat_grey",
        ),
        *(_refuse_with_labels(name) for name in ("seed", "threshold", "box")),
        *(
            _refuse_with_mesh(name)
            for name in (
                "calibration", "spacing", "shape", "labels", "threshold", "seed", "box", "mirror",
                "nan_as_air", "coat", "scale_length", "scale_ball",
            )
        ),
    )  # fmt: skip

    scan: Path | None = option(
        file("file or folder"),
        "volume, folder of slices, or closed surface mesh",
        key="file",
        metavar="SCAN",
        positional=True,
        example="scan.tif",
        recommended=True,
    )
    density: WithSd | None = option(
        VALUE_WITH_SD,
        "density of the bone, kg/m3",
        unit="kg_m3",
        metavar="RHO[+-SD]",
        group=_MASS,
        example="1900+-60",
        recommended=True,
    )
    mass_mg: WithSd | None = option(
        VALUE_WITH_SD,
        "mass of the bone from a balance, mg",
        metavar="M[+-SD]",
        group=_MASS,
        example="3.1+-0.05",
    )
    calibration: Path | None = option(
        file("TOML file"),
        "density of every voxel from its grey value",
        metavar="FILE.toml",
        group=_MASS,
        example="calibration.toml",
    )
    add_mass: tuple[tuple[float, ...], ...] = option(
        MASSES,
        "a bead, glue, a tendon stump: a point mass at x, y, z (scan mm), mg; may be repeated",
        (),
        group=_MASS,
        example=[[4.0, 5.1, 3.3, 0.02]],
    )
    spacing_mm: tuple[float, ...] | None = option(
        SPACING, "voxel size, mm; overrides the file", unit="mm", group=_READING, example=0.02
    )
    voxel_size_sd_percent: float | None = option(
        number(
            "a percentage from 0 to 50",
            lambda value: 0.0 <= value < 50.0,
            "Give it in percent, for example 0.2",
        ),
        "standard deviation of the voxel size, percent",
        unit="percent",
        metavar="PERCENT",
        group=_READING,
        example=0.1,
    )
    scale_length: tuple[tuple[float, ...], ...] = option(
        LENGTHS,
        "a length measured on the sample between two points of the scan (mm): corrects the voxel size and "
        "states its sd; may be repeated",
        (),
        group=_READING,
        example=[[1.0, 2.0, 3.0, 9.0, 2.0, 3.0, 8.012, 0.01]],
    )
    scale_ball: tuple[tuple[float, ...], ...] = option(
        BALLS,
        "a ball of known diameter near a point of the scan (mm), with air around it: as scale-length",
        (),
        group=_READING,
        example=[[4.0, 5.0, 9.0, 1.0, 0.001]],
    )
    mirror: str | None = option(
        choice("x", "y", "z"),
        "reverse the slices along an axis; points are those of the mirrored scan",
        group=_READING,
        example="z",
    )
    nan_as_air: bool = option(FLAG, "let voxels that are not finite be air", False, group=_READING)
    follow: bool = option(FLAG, "let headers name data files outside their own folder", False, group=_READING)
    shape: tuple[int, int, int] | None = option(
        VOXELS, "numbers of voxels; x runs fastest in the file", group=_RAW, example=[512, 512, 600]
    )
    dtype: str | None = option(
        VOXEL_TYPE, ", ".join(VOXEL_TYPE.choices), metavar="TYPE", group=_RAW, example="uint16"
    )
    byte_order: str | None = option(
        choice("little", "big"), "order of the bytes of a voxel (little)", group=_RAW, example="little"
    )
    header_bytes: int | None = option(at_least(0), "bytes before the first voxel (0)", group=_RAW, example=0)
    labels: Path | None = option(
        file("label volume"), "label volume; never written over", group=_FINDING, example="labels.nrrd"
    )
    stapes_label: int | None = option(
        at_least(1),
        "number of the stapes in it (that of the segment named stapes, else 1)",
        group=_FINDING,
        example=1,
    )
    plate_label: int | None = option(
        at_least(1),
        "number of the plate in it (that of the segment named plate, else 2)",
        group=_FINDING,
        example=2,
    )
    threshold: float | None = option(
        NUMBER, "grey value between air and bone", metavar="T", group=_FINDING, example=12000
    )
    seed_mm: tuple[float, float, float] | None = option(
        POINT, "a point inside the stapes, scan mm", unit="mm", group=_FINDING, example=[4.1, 5.0, 3.2]
    )
    box_mm: tuple[float, float, float, float, float, float] | None = option(
        BOX,
        "part of the scan to look at, scan mm",
        unit="mm",
        group=_FINDING,
        example=[0.0, 0.0, 0.0, 8.0, 8.0, 6.0],
    )
    coat_um: WithSd | None = option(
        VALUE_OR_ZERO_WITH_SD,
        "thickness of mucosa on the bone, um, subtracted with its image; 0 for cleaned bone (without SD: a "
        "third)",
        unit="um",
        metavar="T[+-SD]",
        group=_FINDING,
        example="35+-12",
    )
    coat_grey: WithSd = option(
        VALUE_WITH_SD,
        "its grey value above air, as a share of that of bone",
        "0.15+-0.05",
        metavar="G[+-SD]",
        group=_FINDING,
        example="0.15+-0.05",
    )
    anterior: tuple[float, float, float] | None = option(
        DIRECTION,
        "direction towards anterior in scan axes; only its sign along the footplate is used",
        group=_FRAMES,
        example=[-0.9, 0.1, 0.0],
    )
    side: str | None = option(
        choice("left", "right"),
        "names z superior (left) or inferior (right)",
        group=_FRAMES,
        example="left",
    )
    landmarks: Path | None = option(
        file("file of landmarks"),
        ".mrk.json, .fcsv, .pp or .csv with points named anterior, posterior, superior, inferior, head, "
        "footplate_centre",
        group=_FRAMES,
        example="landmarks.mrk.json",
    )
    plate_fiducials: Path | None = option(
        file("fiducials file"),
        "CSV name, x_mm, y_mm, z_mm in the scan [, x_ref_mm, y_ref_mm, z_ref_mm in the plate frame]",
        group=_FRAMES,
        example="plate_fiducials.csv",
    )

    @property
    def raw(self) -> RawLayout | None:
        """How raw voxels lie in a scan without a header."""
        if self.shape is None or self.dtype is None:
            return None
        from legacy.ct_inertia.readers.raw_layout import RawLayout

        return RawLayout(self.shape, self.dtype, self.byte_order or "little", self.header_bytes or 0)

    @property
    def voxel_size_sd(self) -> float | None:
        """Relative standard deviation of the voxel size."""
        return None if self.voxel_size_sd_percent is None else self.voxel_size_sd_percent / 100.0

    @property
    def is_mesh(self) -> bool:
        """Whether the input is a surface mesh, by its suffix."""
        return is_mesh(self.scan)

    @property
    def mass_known_by(self) -> str:
        """Which of those given leads: ``mass``, then ``calibration``, then ``density``."""
        if self.mass_mg is not None:
            return "mass"
        return "density" if self.calibration is None else "calibration"

    @property
    def inputs(self) -> dict[str, Path | None]:
        """Every input file by its role, the data files of headers among them."""
        from legacy.ct_inertia.readers.companions import with_data_files

        return with_data_files(self.input_files())


@dataclass(frozen=True)
class MassOutputs(OptionTable):
    """What the command writes."""

    title = "ct2mass"
    error = CtInertiaError

    out: Path | None = option(FOLDER, "default <scan name>_mass", group=_OUTPUT, example="ear_mass")
    no_report: bool = option(FLAG, "do not write report.html", False, group=_OUTPUT)
    export: tuple[str, ...] = option(
        several(*EXPORTS),
        summaries(EXPORTS),
        (),
        group=_OUTPUT,
        example=["stl", "mjcf"],
    )
    smooth: int | None = option(
        at_least(0), "steps of smoothing of the surface shown and exported", group=_OUTPUT, example=20
    )
    faces: int | None = option(
        at_least(0), "triangles of the surface shown and exported", group=_OUTPUT, example=20000
    )
    sha256: bool = option(FLAG, "hash the inputs with SHA-256", False, group=_OUTPUT)
    force: bool = option(
        FLAG,
        "replace outputs that this command did not write, or that were edited",
        False,
        group=_OUTPUT,
    )
