"""The scale of the voxels: known lengths against those measured in the scan with the stated voxel size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from legacy.ct_inertia.options import MassOptions
    from legacy.ct_inertia.volume.volume import Volume

CODE = "voxel_scale_corrected"
# Voxel sizes of laboratory scanners are off by 0.1 to 0.5 % (doi:10.1371/journal.pone.0332263): what is known
# of the scale before a length is measured.
SCANNER_SD = 0.003
SCANNER_WORDS = "scanners are off by 0.1 to 0.5 %, doi:10.1371/journal.pone.0332263; inertia by 5 times that"
# A point that is picked in a viewer lies evenly within a voxel.
_PICKED_VOXELS = 1.0 / np.sqrt(12.0)
# A factor that no scanner needs: another length was measured.
_MOST = 0.1


@dataclass(frozen=True)
class VoxelScale:
    """The true length of a length of 1 by the voxel size, with its standard deviation.

    Attributes
    ----------
    factor, sd : float
    source : str
        What it was estimated from.
    """

    factor: float
    sd: float
    source: str

    def notice(self, spacing_mm: Sequence[float]) -> Notice:
        """Report the factor, and what it was applied to."""
        spacing = ",".join(f"{self.factor * value:.7g}" for value in spacing_mm)
        text = (
            f"The voxel size was corrected by {100.0 * (self.factor - 1.0):+.3f} +- {100.0 * self.sd:.3f} % "
            f"({self.source}) in volume, mass and mass matrix. Coordinates, frames and surfaces are in mm of "
            f"the scan as it is stored; {named('spacing')} {spacing} corrects those too."
        )
        return Notice(CODE, text)


def voxel_scale(options: MassOptions, volume: Volume) -> VoxelScale | None:
    """Estimate the scale from stated lengths and balls; None where none is given.

    Parameters
    ----------
    options : MassOptions
    volume : Volume

    Notes
    -----
    Mean, weighted by information, of the measured factors and of 1 with the standard deviation of the voxel
    size (stated, else that of laboratory scanners).

    Raises
    ------
    CtInertiaError
        A length differs from the scan by more than 10 %, or a ball is not seen where it is stated.
    """
    picked = _PICKED_VOXELS * float(np.mean(volume.spacing_mm))
    lengths: list[tuple[str, float, float]] = []
    for row in options.scale_length:
        apart = float(np.linalg.norm(np.subtract(row[3:6], row[:3])))
        length, sd = row[6], row[7]
        if apart == 0.0:
            raise _unfit("{scale_length}", length, apart)
        lengths.append(("{scale_length}", length / apart, np.hypot(sd, np.sqrt(2.0) * picked) / apart))
    for row in options.scale_ball:
        from legacy.ct_inertia.grey.ball_diameter import ball_diameter

        measured, measured_sd = ball_diameter(volume, np.array(row[:3]), row[3])
        lengths.append(("{scale_ball}", row[3] / measured, np.hypot(row[4], measured_sd) / measured))
    if not lengths:
        return None
    for name, factor, _ in lengths:
        if not abs(factor - 1.0) < _MOST:
            raise _unfit(name, factor, 1.0)
    known = SCANNER_SD if options.voxel_size_sd is None else max(options.voxel_size_sd, 1e-6)
    factors = np.array([1.0, *(factor for _, factor, _ in lengths)])
    weights = 1.0 / np.square([known, *(sd for _, _, sd in lengths)])
    words = f"{len(lengths)} stated length{'s' if len(lengths) > 1 else ''}, and {100.0 * known:.2g} % before"
    return VoxelScale(float(weights @ factors / weights.sum()), float(1.0 / np.sqrt(weights.sum())), words)


def _unfit(name: str, stated: float, measured: float) -> CtInertiaError:
    return CtInertiaError.of(
        name,
        "within 10 % of the length in the scan",
        f"{stated:g} against {measured:g}",
        next_step="Check the points (scan coordinates, mm), the length in mm, and {spacing}",
    )
