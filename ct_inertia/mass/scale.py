"""The scale of the voxels: known lengths against those measured in the scan with the stated voxel size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.warnings import Notice

SCANNER_SD = 0.003
"""Relative standard deviation of the voxel size of laboratory scanners, off by 0.1 to 0.5 %
(doi:10.1371/journal.pone.0332263): what is known of the scale before a length is measured."""

SCANNER_WORDS = "scanners are off by 0.1 to 0.5 %, doi:10.1371/journal.pone.0332263; inertia by 5 times that"

_PICKED_VOXELS = 1.0 / np.sqrt(12.0)  # a point that is picked in a viewer lies evenly within a voxel
_MOST = 0.1  # a factor that no scanner needs: another length was measured


@dataclass(frozen=True)
class VoxelScale:
    """The true length of a length of 1 by the voxel size, its standard deviation, and what it is from."""

    factor: float
    sd: float
    source: str

    def notice(self, spacing_mm: Array) -> Notice:
        """Report the factor, and what it was applied to."""
        spacing = ",".join(f"{self.factor * value:.7g}" for value in spacing_mm)
        text = (
            f"The voxel size was corrected by {100.0 * (self.factor - 1.0):+.3f} ± {100.0 * self.sd:.3f} % "
            f"({self.source}) in volume, mass and mass matrix. Coordinates, frames and surfaces are in mm of "
            f"the scan as it is stored; --spacing {spacing} corrects those too."
        )
        return Notice("file_read", text)


def voxel_scale(
    lengths: Sequence[Sequence[float]], spacing_mm: Array, voxel_size_sd: float | None
) -> VoxelScale | None:
    """Estimate the scale from stated lengths; None where none is given.

    Parameters
    ----------
    lengths : sequence of (x0, y0, z0, x1, y1, z1, length, sd)
        Two points in scan mm, and the true distance between them with its standard deviation, mm.
    spacing_mm : ndarray, (3,)
    voxel_size_sd : float or None
        Relative standard deviation of the voxel size; None: that of laboratory scanners.

    Raises
    ------
    StapeskitError
        A length differs from the scan by more than 10 %.

    Notes
    -----
    Mean, weighted by information, of the measured factors and of 1 with the standard deviation of the voxel
    size.
    """
    if not lengths:
        return None
    picked = _PICKED_VOXELS * float(np.mean(spacing_mm))
    known = SCANNER_SD if voxel_size_sd is None else max(voxel_size_sd, 1e-6)
    factors, sds = [1.0], [known]
    for row in lengths:
        apart = float(np.linalg.norm(np.subtract(row[3:6], row[:3])))
        length, sd = row[6], row[7]
        if not abs(length - apart) < _MOST * apart:
            expected = (
                f"within {100 * _MOST:.0f} % of the distance of its points in the scan ({apart:.4g} mm)"
            )
            step = "Check the points (scan mm) and the voxel spacing"
            raise StapeskitError.of("--scale-length", expected, f"{length:g} mm", next_step=step)
        factors.append(length / apart)
        sds.append(float(np.hypot(sd, np.sqrt(2.0) * picked)) / apart)
    weights = 1.0 / np.square(sds)
    plural = "s" if len(lengths) > 1 else ""
    words = f"{len(lengths)} stated length{plural}, and {100.0 * known:.2g} % before"
    return VoxelScale(float(weights @ factors / weights.sum()), float(1.0 / np.sqrt(weights.sum())), words)
