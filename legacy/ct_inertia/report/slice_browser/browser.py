"""Grey values and labels around the stapes as data of the page; browser.js draws them."""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.bodies import STAPES
from legacy.ct_inertia.report.colours import BODY_COLOURS, CUT
from legacy.ct_inertia.report.slices_figure import NAMES, Crop
from legacy.stapeskit.page import page

if TYPE_CHECKING:
    from markupsafe import Markup

# Voxels of the copy in the page: with 5 bits of grey value some 0.5 MB.
_MOST_VOXELS = 900_000
_GREY_LEVELS = 31
_PARTS = Path(__file__).parent


def slice_browser(crop: Crop) -> Markup:
    """Return the picture with its controls, data and script."""
    data = json.dumps(picture_data(crop), separators=(",", ":"))
    block = page.template(_part("browser.html"))
    return page.with_script(block, _part("browser.css"), "slices-data", data, _part("browser.js"))


def _part(name: str) -> str:
    return (_PARTS / name).read_text(encoding="utf-8")


def picture_data(crop: Crop) -> dict[str, Any]:
    """Return the voxels, thinned to whole steps, and their place in the scan; JSON-able.

    A byte holds a grey value in its upper five bits and a label in its lower three.
    """
    step = max(1, int(np.ceil((crop.grey.size / _MOST_VOXELS) ** (1.0 / 3.0))))
    low, high = crop.window
    grey = np.clip((_block(crop.grey, step, "mean") - low) / max(high - low, 1e-9), 0.0, 1.0)
    labels = crop.labels[::step, ::step, ::step].copy()
    labels[_block(crop.mask(CUT), step, "any")] = 4
    values = (np.round(grey * _GREY_LEVELS).astype(np.uint8) << 3) | labels
    # level 9 takes 20 times as long, 0.5 to 1 s, for 6 % fewer bytes
    packed = zlib.compress(values.tobytes(), 6)
    volume = crop.volume
    first = volume.scan_points(np.asarray(crop.low, dtype=float)[None])[0]
    steps = [
        (volume.scan_points((crop.low + step * np.eye(3)[axis])[None])[0] - first).tolist()
        for axis in range(3)
    ]
    return {
        "voxels": base64.b64encode(packed).decode(),
        "size": list(values.shape[::-1]),
        "step": step,
        "spacing_mm": (volume.spacing_mm * step).tolist(),
        "first_index": [int(index) for index in crop.low],
        "first_mm": first.tolist(),
        "step_mm": steps,
        "axis": _best_axis(crop),
        "middle": [int(index) // step for index in crop.middle],
        "names": [NAMES.get(label, "") for label in (0, 1, 2, 3, CUT)],
        "colours": [BODY_COLOURS.get(label, "#000000") for label in (0, 1, 2, 3, CUT)],
    }


def _best_axis(crop: Crop) -> int:
    """Return the scan axis (0 x, 1 y, 2 z) whose middle slice shows most of the stapes."""
    stapes = crop.mask(STAPES)
    shown = [int(np.sum(np.take(stapes, int(crop.middle[axis]), axis=2 - axis))) for axis in range(3)]
    return int(np.argmax(shown))


def _block(values: NDArray[Any], step: int, how: str) -> NDArray[Any]:
    """Return the mean of each block of ``step`` voxels an axis, or whether any of it is true."""
    if step == 1:
        return values
    pad = [(0, -size % step) for size in values.shape]
    filled = np.pad(values, pad, mode="edge")
    shape = [part for size in filled.shape for part in (size // step, step)]
    return np.asarray(getattr(np, how)(filled.reshape(shape), axis=(1, 3, 5)))
