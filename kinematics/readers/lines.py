"""The frequency lines of several recordings joined to one list, or refused when they nearly meet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinematics.errors import sentence
from kinematics.readers.recording import Recording

Array = NDArray[np.float64]
Index = NDArray[np.intp]
# Texts hold six digits of a step, and the error of a step grows with the number of the line.
SAME_LINE = 1e-5
_CLOSE = 0.1


def joined_lines(recordings: Sequence[Recording]) -> tuple[Array, list[Index]]:
    """Return the lines of all recordings, ascending, and the places of each recording's own ones.

    Parameters
    ----------
    recordings : sequence of Recording
        Without a DC line.

    Returns
    -------
    ndarray, (line,)
        Frequencies closer than ``SAME_LINE`` (relative), and a tenth of the spacing, are one.
    list of ndarray
    """
    grids: dict[bytes, Array] = {}
    keys = []
    for one in recordings:
        keys.append(one.freq_hz.tobytes())
        grids.setdefault(keys[-1], one.freq_hz)
    every = np.unique(np.concatenate(list(grids.values())))
    spacing = min((float(np.min(np.diff(grid))) for grid in grids.values() if len(grid) > 1), default=np.inf)
    new = np.concatenate([[True], np.diff(every) > np.minimum(SAME_LINE * every[1:], _CLOSE * spacing)])
    lines, rank = every[new], np.cumsum(new) - 1
    places = {key: rank[np.searchsorted(every, grid)] for key, grid in grids.items()}
    return lines, [places[key] for key in keys]


def line_faults(lines: Array, places: Sequence[Index], recordings: Sequence[Recording]) -> list[str]:
    """List lines that nearly meet: too far apart to be one, too close to be two of one measurement.

    Two lines closer than a tenth of the spacing are told when no recording has both.
    """
    grids = {place.tobytes(): (place, one) for place, one in zip(places, recordings, strict=True)}
    if len(grids) < 2:
        return []
    has = np.zeros((len(grids), len(lines)), dtype=bool)
    for row, (place, _) in enumerate(grids.values()):
        has[row, place] = True
    spacing = min(float(np.min(np.diff(lines[p]))) if len(p) > 1 else np.inf for p, _ in grids.values())
    close = np.flatnonzero(np.diff(lines) < min(_CLOSE * spacing, 1e-3 * float(lines[-1])))
    faults = []
    for at in close[:3]:
        if np.any(has[:, at] & has[:, at + 1]):
            continue
        names = [
            next(one.where for row, (_, one) in enumerate(grids.values()) if has[row, line])
            for line in (at, at + 1)
        ]
        step = "Measure all points at the same frequencies, or correct the step of the frequency axis"
        got = f"{lines[at]:.9g} Hz ({names[0]}) and {lines[at + 1]:.9g} Hz ({names[1]})"
        faults.append(
            sentence("the frequencies of all points", f"the same within {SAME_LINE:g}", got, "", step)
        )
    return faults
