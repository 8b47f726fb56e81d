"""The recorded inputs: unpacked once a run; scans are stored without their noise, which is added here.

The noise comes from the raw 64-bit words of PCG64, whose stream numpy guarantees, by whole numbers alone.
"""

from __future__ import annotations

import lzma
import tarfile
from pathlib import Path

import numpy as np

ARCHIVE = Path(__file__).parent / "inputs.tar.xz"
NOISE_SD = 880.0
_SD_OF_EIGHT_BYTES = np.sqrt(8 * (256.0**2 - 1.0) / 12.0)


def unpack(folder: Path) -> Path:
    """Write the inputs into a folder, make the scans of their clean pictures, and return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with lzma.open(ARCHIVE) as stream, tarfile.open(fileobj=stream) as archive:
        archive.extractall(folder, filter="data")
    for path in sorted(folder.rglob("*.clean.npz")):
        _make_scan(path)
    return folder


def noise(count: int, seed: int) -> np.ndarray:
    """Return whole numbers of mean zero and standard deviation ``NOISE_SD``, nearly normal."""
    words = np.random.PCG64(seed).random_raw(count)
    total = words.view(np.uint8).reshape(count, 8).sum(axis=1, dtype=np.int64) - 1020
    return (total * round(NOISE_SD / _SD_OF_EIGHT_BYTES * 64)) >> 6


def _make_scan(path: Path) -> None:
    import tifffile

    with np.load(path) as stored:
        clean, spacing = stored["grey"], stored["spacing_mm"]
    grey = clean.astype(np.int64) * 257
    grey += noise(grey.size, int(clean.shape[0])).reshape(grey.shape)
    tifffile.imwrite(
        path.with_name(path.name.replace(".clean.npz", ".tif")),
        np.clip(grey, 0, 65535).astype(np.uint16),
        imagej=True,
        resolution=(1.0 / spacing[0], 1.0 / spacing[1]),
        metadata={"spacing": float(spacing[2]), "unit": "mm", "axes": "ZYX"},
    )
    path.unlink()
