"""The options of ``ct2mass``, each declared once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from stapeskit.faults import Fault
from stapeskit.option_types import (
    Box,
    Count,
    CountOrZero,
    Direction,
    Flag,
    Folder,
    Kind,
    Masses,
    Number,
    Percent,
    Point,
    PositiveWithSd,
    ReadFile,
    Spacing,
    WithSd,
    Words,
    ZeroOrWithSd,
    numbers,
    require,
)
from stapeskit.options import Opt, Options, Rule

if TYPE_CHECKING:
    from ct_inertia.grey.media import Coat
    from ct_inertia.scan.raw import RawLayout

ASSUMED_DENSITY = WithSd(1900.0, 200.0)
"""Density of bone, kg/m3, where nothing is given (contract); its spread is that of published models of the
middle ear (`ct_inertia.mass.sizes`)."""
MESH_SUFFIXES = (".stl", ".ply", ".obj", ".glb")
EXPORTS = ("stl", "obj", "glb", "mat", "crop")
"""What ``--export`` writes; each is an entry of `ct_inertia.exports.write.EXPORTS`."""

PLAUSIBLE_DENSITY_KG_M3 = (500.0, 4000.0)
"""Refused outside: it holds every bone (1300 to 2200 are published), and no density in a wrong unit."""

_READING = "reading"
_MASS = "mass (a measured mass leads, then a calibration, then a density)"
_FINDING = "finding the stapes"
_FRAMES = "frames"
_OUTPUT = "output"
_SPACING_MM = (1e-4, 3.0)  # beyond, a stapes would have 30 000 voxels a side, or less than one
_LEAST_COAT_UM = 1.0  # thinner than a cell: a thickness in mm. Mucosa of the middle ear has 20 to 50 um
_COAT_GREY = (0.15, 0.05)  # of soft tissue over bone, above air, in the usual micro-CT
_UNSTATED_COAT_SD = 1.0 / 3.0


def _voxels(value: Any) -> tuple[int, ...]:
    found = numbers(value, 3)
    require(all(count == int(count) and count >= 1 for count in found))
    return tuple(int(count) for count in found)


Voxels = Annotated[tuple[int, ...], Kind(_voxels, "three whole numbers of voxels x, y, z", "NX,NY,NZ")]


def is_mesh(path: Path | None) -> bool:
    """Return whether an input is a surface mesh, by its suffix."""
    return path is not None and Path(path).suffix.lower() in MESH_SUFFIXES


def _sd_below_value(key: str, flag: str) -> Rule:
    """Return the rule that a value is larger than its standard deviation."""
    fault = Fault(
        f"the standard deviation of {flag}", "smaller than its value", "more", "", "Leave this value out"
    )
    return Rule(
        lambda v: (x := getattr(v, key)) is not None and x.sd is not None and 0.0 < x.value <= x.sd, fault
    )


def _without(flag: str, reason: str, step: str, excluded: Callable[[Any], bool]) -> Rule:
    """Return the rule that another input excludes an option."""
    fault = Fault(flag, f"left out {reason}", "given", "", step)
    return Rule(lambda v: excluded(v) and getattr(v, _VOXELS[flag]) not in (None, (), False), fault)


_VOXELS = {
    "--spacing": "spacing_mm",
    "--mirror": "mirror",
    "--nan-as-air": "nan_as_air",
    "--shape": "shape",
    "--calibration": "calibration",
    "--labels": "labels",
    "--threshold": "threshold",
    "--seed": "seed_mm",
    "--box": "box_mm",
    "--coat": "coat_um",
}
"""Options about grey values or voxels."""

_MESH = "when the input is a surface mesh", "It is about grey values or voxels"
_LABELLED = "with --labels, which say where the stapes is", "Leave it out"


class MassOptions(Options):
    """Everything that decides a mass matrix: options of ``ct2mass``, keys of ``[scan]``."""

    table: ClassVar[str] = "scan"
    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(
            lambda v: v.file is None and v.labels is None,
            Fault("SCAN", "given, or --labels", "nothing", "", "ct2mass --help shows examples"),
        ),
        Rule(
            lambda v: (
                v.spacing_mm is not None
                and not _SPACING_MM[0] <= min(v.spacing_mm) <= max(v.spacing_mm) <= _SPACING_MM[1]
            ),
            lambda v: Fault(
                "--spacing", "the size of a voxel in mm", v.spacing_mm, "", "A voxel of 20 um is 0.02"
            ),
        ),
        Rule(
            lambda v: (
                v.density_kg_m3 is not None
                and not PLAUSIBLE_DENSITY_KG_M3[0] <= v.density_kg_m3.value <= PLAUSIBLE_DENSITY_KG_M3[1]
            ),
            lambda v: Fault(
                "--density", "between 500 and 4000 kg/m3", v.density_kg_m3, "", "1 g/cm3 is 1000 kg/m3"
            ),
        ),
        Rule(
            lambda v: v.coat_um is not None and 0.0 < v.coat_um.value < _LEAST_COAT_UM,
            lambda v: Fault("--coat", "0, or a thickness in um", v.coat_um, "", "Mucosa has 20 to 50 um"),
        ),
        Rule(
            lambda v: (v.shape is None) != (v.dtype is None),
            Fault("--shape and --dtype", "given together", "one of them", "", "Both lay out raw voxels"),
        ),
        Rule(
            lambda v: v.shape is None and (v.byte_order or v.header_bytes is not None),
            Fault("--byte-order and --header-bytes", "given with --shape and --dtype", "alone"),
        ),
        Rule(
            lambda v: v.labels is None and (v.stapes_label or v.plate_label) and v.file is not None,
            Fault("--stapes-label and --plate-label", "given with --labels", "without"),
        ),
        Rule(
            lambda v: v.close and not is_mesh(v.file),
            Fault("--close", "given with a surface mesh", "without", "", "It closes holes of a mesh"),
        ),
        *(
            _sd_below_value(*pair)
            for pair in (("density_kg_m3", "--density"), ("mass_mg", "--mass-mg"), ("coat_um", "--coat"))
        ),
        *(_without(flag, *_MESH, lambda v: is_mesh(v.file)) for flag in _VOXELS),
        *(
            _without(flag, *_LABELLED, lambda v: v.labels is not None)
            for flag in ("--threshold", "--seed", "--box")
        ),
    )

    file: Annotated[
        ReadFile | None,
        Opt(
            "volume, folder of slices, or closed surface mesh (mm)",
            name="scan",
            positional=True,
            example="scan.tif",
            recommended=True,
        ),
    ] = None
    spacing_mm: Annotated[Spacing | None, Opt("size of a voxel, mm; wins over the file", _READING, 0.018)] = (
        None
    )
    mirror: Annotated[
        Literal["x", "y", "z"] | None,
        Opt("reverse an axis: undoes a mirror image", _READING, "z"),
    ] = None
    nan_as_air: Annotated[Flag, Opt("count voxels that are not finite as air", _READING)] = False
    shape: Annotated[
        Voxels | None,
        Opt("voxels of a file without a header; x runs fastest", _READING, [512, 512, 600]),
    ] = None
    dtype: Annotated[
        Literal["uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64"] | None,
        Opt("type of its voxels", _READING, "uint16"),
    ] = None
    byte_order: Annotated[
        Literal["little", "big"] | None,
        Opt("order of its bytes; default little", _READING, "little"),
    ] = None
    header_bytes: Annotated[CountOrZero | None, Opt("bytes before its voxels; default 0", _READING, 0)] = None
    close: Annotated[Flag, Opt("close the holes of a surface mesh", _READING)] = False
    density_kg_m3: Annotated[
        PositiveWithSd | None,
        Opt(
            f"density of bone, kg/m3; default {ASSUMED_DENSITY}, with a warning",
            _MASS,
            "1900+-60",
            recommended=True,
        ),
    ] = None
    mass_mg: Annotated[
        PositiveWithSd | None, Opt("mass of the stapes alone, mg, from a balance", _MASS, "3.1+-0.05")
    ] = None
    calibration: Annotated[
        ReadFile | None, Opt("grey value to density (TOML)", _MASS, "calibration.toml")
    ] = None
    add_mass: Annotated[
        Masses,
        Opt("a bead, glue, a tendon stump: scan mm and mg", _MASS, [[4.1, 5.0, 3.2, 0.06]], repeats=True),
    ] = ()
    voxel_size_sd_percent: Annotated[
        Percent | None, Opt("standard deviation of the voxel size, percent", _MASS, 0.2)
    ] = None
    labels: Annotated[
        ReadFile | None, Opt("label volume; never written over", _FINDING, "labels.seg.nrrd")
    ] = None
    stapes_label: Annotated[
        Count | None, Opt("number of the stapes in it; default segment named stapes, else 1", _FINDING, 1)
    ] = None
    plate_label: Annotated[
        Count | None, Opt("number of the plate in it; default segment named plate, else 2", _FINDING, 2)
    ] = None
    threshold: Annotated[Number | None, Opt("grey value between air and bone", _FINDING, 12000)] = None
    seed_mm: Annotated[Point | None, Opt("a point inside the stapes, scan mm", _FINDING, [4.1, 5.0, 3.2])] = (
        None
    )
    box_mm: Annotated[
        Box | None, Opt("part of the scan to look at, scan mm", _FINDING, [0.0, 0.0, 0.0, 8.0, 8.0, 6.0])
    ] = None
    coat_um: Annotated[
        ZeroOrWithSd | None,
        Opt("mucosa to be subtracted, um; 0 for cleaned bone", _FINDING, "35+-12"),
    ] = None
    anterior: Annotated[
        Direction | None,
        Opt(
            "direction towards anterior in scan axes; its sign along the footplate counts",
            _FRAMES,
            [-0.9, 0.1, 0.0],
            recommended=True,
        ),
    ] = None
    side: Annotated[
        Literal["left", "right"] | None,
        Opt("names z superior (left) or inferior (right)", _FRAMES, "left", recommended=True),
    ] = None
    landmarks: Annotated[
        ReadFile | None,
        Opt(
            ".mrk.json, .fcsv or .csv with points named anterior, posterior, superior, inferior, head, "
            "footplate_centre",
            _FRAMES,
            "landmarks.mrk.json",
        ),
    ] = None
    plate_fiducials: Annotated[
        ReadFile | None,
        Opt(
            "CSV name, x_mm, y_mm, z_mm in the scan [, x_ref_mm, y_ref_mm, z_ref_mm in the plate frame]",
            _FRAMES,
            "plate_fiducials.csv",
        ),
    ] = None

    @property
    def is_mesh(self) -> bool:
        """Whether the input is a surface mesh, by its suffix."""
        return is_mesh(self.file)

    @property
    def source(self) -> Path:
        """The file that was measured: the scan, or labels alone."""
        return Path(str(self.file if self.file is not None else self.labels))

    @property
    def raw(self) -> RawLayout | None:
        """How raw voxels lie in a scan without a header."""
        if self.shape is None or self.dtype is None:
            return None
        from ct_inertia.scan.raw import RawLayout

        return RawLayout(self.shape, self.dtype, self.byte_order or "little", self.header_bytes or 0)

    @property
    def coat(self) -> Coat | None:
        """The soft coat that was stated, with a third of its thickness where it has no standard deviation."""
        if self.coat_um is None:
            return None
        from ct_inertia.grey.media import Coat

        thickness, sd = self.coat_um.value, self.coat_um.sd
        sd = thickness * _UNSTATED_COAT_SD if sd is None else sd
        return Coat(1e-3 * thickness, 1e-3 * sd, *_COAT_GREY)

    @property
    def voxel_size_sd(self) -> float | None:
        """Relative standard deviation of the voxel size."""
        return None if self.voxel_size_sd_percent is None else self.voxel_size_sd_percent / 100.0

    @property
    def inputs(self) -> dict[str, Path]:
        """Every file that was given, by its role."""
        found = {
            "scan": self.file,
            "labels": self.labels,
            "landmarks": self.landmarks,
            "plate_fiducials": self.plate_fiducials,
            "calibration": self.calibration,
        }
        return {role: Path(path) for role, path in found.items() if path is not None}


class MassOutputs(Options):
    """What the command writes."""

    out: Annotated[Folder | None, Opt("default <scan name>_mass", _OUTPUT, "ear_mass")] = None
    no_report: Annotated[Flag, Opt("do not write report.html", _OUTPUT)] = False
    export: Annotated[Words, Opt(f"further files: {', '.join(EXPORTS)}", _OUTPUT, ["stl", "mat"])] = ()
    force: Annotated[Flag, Opt("replace files that this command did not write", _OUTPUT)] = False
    as_json: Annotated[Flag, Opt("print mass.json", _OUTPUT, name="json")] = False
    quiet: Annotated[Flag, Opt("print nothing but errors", _OUTPUT)] = False
    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(
            lambda v: set(v.export) - set(EXPORTS),
            lambda v: Fault("--export", f"out of {', '.join(EXPORTS)}", ", ".join(v.export)),
        ),
    )
