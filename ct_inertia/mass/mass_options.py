"""What a user can say to `ct2mass`, checked before any file is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ct_inertia.errors import CtInertiaError
from ct_inertia.mass.mass_properties import PointMass
from ct_inertia.surface.surface import SURFACE_SUFFIXES
from stapeskit.faults import Fault

if TYPE_CHECKING:
    from ct_inertia.readers.raw_layout import RawLayout

Value = tuple[float, float | None]


@dataclass(frozen=True)
class MassOptions:
    """What a user can say to `ct2mass`; every field is one option.

    Attributes
    ----------
    scan : Path or None
        Volume, folder of slices or closed surface mesh (mm); None with ``labels`` alone.
    density, mass_mg : (value, sd or None) or None
        kg/m3 and mg. At least one of these and ``calibration``; the mass leads, then the calibration.
    calibration : Path or None
    spacing_mm : tuple of 1 or 3 floats, or None
    raw : RawLayout or None
        How raw voxels lie in a scan without a header.
    labels : Path or None
        A label volume made elsewhere.
    stapes_label, plate_label : int
    landmarks, plate_fiducials : Path or None
    side : str or None
        ``left`` or ``right``.
    anterior : tuple of 3 floats, or None
        Direction in scan axes.
    threshold : float or None
        Grey value between air and bone.
    seed_mm : tuple of 3 floats, or None
        A point inside the stapes, scan coordinates.
    box_mm : tuple of 6 floats, or None
        Two corners of the part of the scan to look at.
    mirror : str or None
        ``x``, ``y`` or ``z``. Landmarks, seed and box are then coordinates of the mirrored scan.
    nan_as_air : bool
    added : tuple of PointMass
    voxel_size_sd : float or None
        Relative standard deviation of the voxel size.
    """

    scan: Path | None
    density: Value | None = None
    mass_mg: Value | None = None
    calibration: Path | None = None
    spacing_mm: tuple[float, ...] | None = None
    labels: Path | None = None
    stapes_label: int = 1
    plate_label: int = 2
    landmarks: Path | None = None
    plate_fiducials: Path | None = None
    side: str | None = None
    anterior: tuple[float, float, float] | None = None
    threshold: float | None = None
    seed_mm: tuple[float, float, float] | None = None
    box_mm: tuple[float, float, float, float, float, float] | None = None
    mirror: str | None = None
    nan_as_air: bool = False
    added: tuple[PointMass, ...] = ()
    voxel_size_sd: float | None = None
    raw: RawLayout | None = None

    def __post_init__(self) -> None:
        if self.scan is None and self.labels is None:
            raise CtInertiaError(
                Fault("the scan", "given as the first argument", "none", next_step="Or give --labels alone")
            )
        if self.density is None and self.mass_mg is None and self.calibration is None:
            raise CtInertiaError(
                Fault(
                    "the mass of the stapes",
                    "given by at least one of --density, --mass-mg and --calibration",
                    "none of them",
                    next_step="Bone has 1400 to 2200 kg/m3",
                )
            )
        if self.labels is not None and not self.is_mesh:
            self._check_labels()
        if self.is_mesh:
            unused = [name for name, value in self._volume_options() if value]
            if unused:
                raise CtInertiaError(
                    Fault(
                        unused[0],
                        "left out when the input is a surface mesh",
                        "it",
                        str(self.scan),
                        "It speaks of grey values or voxels",
                    )
                )

    def _check_labels(self) -> None:
        """Refuse what would be left unused when labels say where the stapes is."""
        for name, value in (
            ("--seed", self.seed_mm),
            ("--threshold", self.threshold),
            ("--box", self.box_mm),
        ):
            if value is not None:
                raise CtInertiaError(
                    Fault(
                        name,
                        "left out when --labels says where the stapes is",
                        "both",
                        next_step=f"Leave out {name} or --labels",
                    )
                )

    def _volume_options(self) -> list[tuple[str, Any]]:
        return [
            ("--calibration", self.calibration),
            ("--spacing", self.spacing_mm),
            ("--shape", self.raw),
            ("--labels", self.labels),
            ("--threshold", self.threshold is not None),
            ("--seed", self.seed_mm),
            ("--box", self.box_mm),
            ("--mirror", self.mirror),
            ("--nan-as-air", self.nan_as_air),
        ]

    @property
    def is_mesh(self) -> bool:
        """Whether the input is a surface mesh by its suffix."""
        return self.scan is not None and Path(self.scan).suffix.lower() in SURFACE_SUFFIXES

    @property
    def mass_known_by(self) -> str:
        """Which of those given leads: ``mass``, then ``calibration``, then ``density``."""
        if self.mass_mg is not None:
            return "mass"
        return "density" if self.calibration is None else "calibration"

    @property
    def inputs(self) -> dict[str, Path | None]:
        """Every input file by its role, the data files of headers among them."""
        from ct_inertia.readers.companions import with_data_files

        return with_data_files(
            {
                "scan": self.scan,
                "labels": self.labels,
                "calibration": self.calibration,
                "landmarks": self.landmarks,
                "plate_fiducials": self.plate_fiducials,
            }
        )
