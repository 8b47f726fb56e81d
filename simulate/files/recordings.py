"""Write a measurement: ldv.csv (tidy), points.csv and fiducials.csv, or what other programs export."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from simulate.files import spectra
from simulate.vibrometer import AVERAGES, Recording
from stapeskit.arrays import Array


def write_recording(folder: Path, recording: Recording, fmt: str = "csv") -> Path:
    """Write a recording, its points and fiducials into a folder in one of WRITERS; return the main file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = WRITERS[fmt](folder, recording)
    if recording.fiducials:
        write_fiducials(folder / "fiducials.csv", recording)
    return path


def write_tidy(folder: Path, recording: Recording) -> Path:
    """Write ldv.csv, one row a run, channel and frequency, missing values empty, and points.csv."""
    write_points(folder / "points.csv", recording)
    runs = recording.runs
    takes = [runs[:k].count(run) + 1 for k, run in enumerate(runs)]
    more_columns = (["run"] if len(runs) > 1 else []) + (["repeat"] if max(takes) > 1 else [])
    digits = ".15g" if recording.stated == "none" and not recording.position_sd_mm else ".7g"
    averages = np.full(recording.sd_m_s.shape, float(AVERAGES))
    columns = {
        "sd": (["sd_m_s"], [recording.sd_m_s]),
        "coherence": (["n_avg", "coherence"], [averages, recording.coherence()]),
        "n_avg": (["n_avg"], [averages]),
        "none": ([], []),
    }
    names, values = columns[recording.stated]
    formats = {"sd_m_s": ".5g", "n_avg": ".0f", "coherence": ".9f"}
    header = ["body,point,dir_x,dir_y,dir_z,freq_hz,re_m_s,im_m_s", *names, *more_columns]
    lines = [",".join(header)]
    freq = [f"{value:.12g}" for value in recording.freq_hz]
    for run, values_of_row in enumerate(zip(runs, takes, strict=True)):
        tail = "".join(f",{value}" for value in values_of_row[: len(more_columns)])
        for channel, body in enumerate(recording.body):
            direction = ",".join(f"{part:.12g}" for part in recording.direction[channel])
            head = f"{body},{recording.point[channel]},{direction}"
            more = [
                [f",{number:{formats[name]}}" for number in column[run, channel].tolist()]
                for name, column in zip(names, values, strict=True)
            ]
            for line, value in enumerate(recording.velocity_m_s[run, channel].tolist()):
                reading = "," if value != value else f"{value.real:{digits}},{value.imag:{digits}}"
                lines.append(f"{head},{freq[line]},{reading}{''.join(part[line] for part in more)}{tail}")
    return _write(folder / "ldv.csv", lines)


def write_points(path: Path, recording: Recording) -> Path:
    """Write the reported places of all points."""
    keys = zip(recording.body, recording.point, strict=True)
    places = dict(zip(keys, recording.position_mm, strict=True))
    sd = recording.position_sd_mm
    rows = [f"{body},{point},{_numbers(place, sd)}" for (body, point), place in places.items()]
    return _write(path, ["body,point,x_mm,y_mm,z_mm" + (",sd_mm" if sd else ""), *rows])


def write_fiducials(path: Path, recording: Recording) -> Path:
    """Write the places of all fiducials, seen and true."""
    sd, frame = recording.fiducial_sd_mm, recording.fiducial_frame
    rows = [f"{name},{_numbers([*seen, *place], sd, frame)}" for name, seen, place in recording.fiducials]
    head = "name,x_mm,y_mm,z_mm,x_ref_mm,y_ref_mm,z_ref_mm,frame" + (",sd_mm" if sd else "")
    return _write(path, [head, *rows])


def _numbers(values: Array | list[float], sd_mm: float, *words: str) -> str:
    digits = ".4f" if sd_mm else ".15g"
    return ",".join([*(f"{value:{digits}}" for value in values), *words, *([f"{sd_mm:g}"] if sd_mm else [])])


def _write(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


WRITERS: dict[str, Callable[[Path, Recording], Path]] = {
    "csv": write_tidy,
    "wide": spectra.write_wide,
    "uff": spectra.write_uff_binary,
    "fastscan": spectra.write_fastscan,
    "mat": spectra.write_matlab,
}
"""Writers by format: they write into a folder, points included, and return the main file or folder."""
