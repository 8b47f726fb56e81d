"""The voxel size in the log next to Bruker/SkyScan slices."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_NUMBER = r"\s*=\s*([0-9.]+(?:[eE][-+]?\d+)?)"


def log_spacing(folder: Path) -> NDArray[np.float64] | None:
    """Return the voxel spacing in a reconstruction log in the folder, mm.

    Returns
    -------
    ndarray, (3,), or None
        None when no log has it, or two of them differ.

    Notes
    -----
    The pixel size of the reconstruction, in um, times the step from section to section along z (NRecon).
    Where the log has no such size, the scaled pixel size of the acquisition: NRecon reconstructs at it
    by default. A size in mm or with another word for the pixel is read too.
    """
    sizes = {entry for path in sorted(folder.glob("*.log")) if (entry := _size(path)) is not None}
    if len(sizes) != 1:
        return None
    ((size, ratio),) = sizes
    return np.array([size, size, size * ratio])


def _size(path: Path) -> tuple[float, float] | None:
    """Return the pixel size, mm, and the step of sections in pixels."""
    text = path.read_text(encoding="latin-1")
    before, _, after = text.partition("[Reconstruction]")
    pixel = re.search(r"^Pixel Size \((um|mm)\)" + _NUMBER, after, re.M)
    pixel = pixel or re.search(r"^(?:Scaled )?Image Pixel Size \((um|mm)\)" + _NUMBER, after, re.M)
    for name in ("Scaled Image Pixel Size", "Image Pixel Size"):
        pixel = pixel or re.search(rf"^{name} \((um|mm)\)" + _NUMBER, before, re.M)
    step = re.search(r"^Section to Section Step" + _NUMBER, after, re.M)
    if pixel is None or float(pixel[2]) <= 0.0:
        return None
    return float(pixel[2]) * (1e-3 if pixel[1] == "um" else 1.0), max(1.0, float(step[1])) if step else 1.0
