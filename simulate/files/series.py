"""Write time series: samples as .npz or .wav, and the table that says what each channel is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from simulate.series import TimeSeries, multisine
from simulate.vibrometer import Recording


def write_npz(folder: Path, series: TimeSeries) -> Path:
    """Write series.npz (m/s and V) and channels.csv; return the first."""
    names: dict[str, Any] = dict(zip(series.names, series.velocity_m_s, strict=True))
    time = np.arange(len(series.drive_v)) / series.rate_hz
    more: dict[str, Any] = {} if series.set_hz is None else {"freq_hz": series.set_hz}
    path = folder / "series.npz"
    np.savez(path, time_s=time, drive=series.drive_v, **names, **more)
    _write_channels(folder / "channels.csv", series, series.names, "drive", ["m/s"] * len(names), ["V"])
    return path


def write_wav(folder: Path, series: TimeSeries) -> Path:
    """Write series.wav, 16 bit, the drive as channel 1, and channels.csv with the sensitivities."""
    from scipy.io import wavfile

    signals = np.vstack([series.drive_v, series.velocity_m_s])
    most = np.max(np.abs(signals), axis=1) * 1.01
    path = folder / "series.wav"
    whole = np.rint(signals / most[:, None] * 32767.0).astype(np.int16)
    wavfile.write(path, int(series.rate_hz), np.ascontiguousarray(whole.T))
    numbers = [str(number) for number in range(2, len(signals) + 1)]
    scales = [f"{scale:.9g} m/s/V" for scale in most[1:]]
    _write_channels(
        folder / "channels.csv", series, numbers, "1", scales, [f"{1.0 / most[0]:.9g} V/V"], "sensitivity"
    )
    return path


def _write_channels(
    path: Path,
    series: TimeSeries,
    names: list[str],
    drive: str,
    units: list[str],
    drive_unit: list[str],
    column: str = "unit",
) -> None:
    recording = series.recording
    rows = [f"channel,role,body,point,dir_x,dir_y,dir_z,{column},x_mm,y_mm,z_mm"]
    rows.append(f"{drive},reference,,,,,,{drive_unit[0]},,,")
    for k, (name, unit) in enumerate(zip(names, units, strict=True)):
        beam = ",".join(f"{v:.12g}" for v in recording.direction[k])
        place = ",".join(f"{v:.6f}" for v in recording.position_mm[k])
        rows.append(f"{name},response,{recording.body[k]},{recording.point[k]},{beam},{unit},{place}")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def write_multisine(folder: Path, recording: Recording) -> Path:
    """Write a recording as the multisine that would give it, as .npz."""
    return write_npz(folder, multisine(recording, noise=0.0))
