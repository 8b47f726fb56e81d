"""What a user says about time series: the channel table and how frequency responses are estimated."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, fields
from pathlib import Path

from kinematics.errors import KinematicsError
from stapeskit.faults import Fault, collecting, raise_all

ESTIMATORS = ("h1", "h2", "hv")
LOCAL = "lpm"
CHOICES = (*ESTIMATORS, LOCAL)
WINDOWS = ("none", "hann", "hamming", "blackman", "flattop")
AVERAGES = 30


@dataclass(frozen=True)
class SeriesOptions:
    """How time series are turned into frequency responses.

    Attributes
    ----------
    channels : Path, optional
        The channel table; None for universal files, which say themselves what they hold.
    reference : str
        The reference among several; empty: the only one.
    estimator : str
        ``h1``, ``h2`` or ``hv`` by segments, or ``lpm``: local polynomials, without windows.
    window : str
    overlap : float
    averages : int
        Segments in a record (30), unless ``resolution_hz`` is given.
    resolution_hz : float
        NaN: by ``averages``.
    period_s : float
        Period of a periodic excitation; NaN: none.
    skip_periods : int
    steps : Path, optional
        CSV with start_s, stop_s, freq_hz of a stepped sine.
    settle : float
        Share of every step left out at its start.
    band_hz : tuple of (float, float), optional
        Lines kept.

    Raises
    ------
    KinematicsError
        A value out of its range or options that exclude each other; all together.
    """

    channels: Path | None = None
    reference: str = ""
    estimator: str = "h1"
    window: str = "hann"
    overlap: float = 0.5
    averages: int = AVERAGES
    resolution_hz: float = float("nan")
    period_s: float = float("nan")
    skip_periods: int = 1
    steps: Path | None = None
    settle: float = 0.2
    band_hz: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        faults = []
        if self.estimator not in CHOICES:
            faults.append(Fault("--frf", ", ".join(CHOICES), self.estimator))
        if self.window not in WINDOWS:
            faults.append(Fault("--window", ", ".join(WINDOWS), self.window))
        if not 0.0 <= self.overlap <= 0.95:
            faults.append(Fault("--overlap", "between 0 and 0.95", self.overlap))
        if self.averages < 3:
            faults.append(Fault("--averages", "3 at least", self.averages))
        if not math.isnan(self.resolution_hz) and not 0.0 < self.resolution_hz < math.inf:
            faults.append(Fault("--resolution", "positive, in Hz", self.resolution_hz))
        if not math.isnan(self.period_s) and not 0.0 < self.period_s < math.inf:
            faults.append(Fault("--period", "positive, in s", self.period_s))
        if not math.isnan(self.period_s) and self.steps is not None:
            step = "Excitation is periodic or stepped"
            faults.append(Fault("--steps", "left out beside --period", self.steps, "", step))
        if self.skip_periods < 0:
            faults.append(Fault("--skip-periods", "0 or more", self.skip_periods))
        if not 0.0 <= self.settle <= 0.9:
            faults.append(Fault("--settle", "from 0 to 0.9", self.settle))
        if self.band_hz is not None and not 0.0 <= self.band_hz[0] < self.band_hz[1]:
            faults.append(Fault("--frf-band", "two frequencies, the lower first", self.band_hz))
        if self.steps is not None and not self.steps.is_file():
            faults.append(Fault("--steps", "an existing file", self.steps, "", "Check its name"))
        if self.channels is not None and not self.channels.is_file():
            faults.append(Fault("--channels", "an existing file", self.channels, "", "Check its name"))
        raise_all(KinematicsError, faults)


_FLAGS = {
    "reference": "--reference-channel",
    "estimator": "--frf",
    "resolution_hz": "--resolution",
    "period_s": "--period",
    "skip_periods": "--skip-periods",
    "band_hz": "--frf-band",
}


def add_series_arguments(made: argparse.ArgumentParser) -> None:
    """Add the options of time series to a command."""
    group = made.add_argument_group(
        "time series (with --channels FILE; universal files say themselves what their time responses are)"
    )
    group.add_argument(
        "--channels", type=Path, metavar="FILE", help="which column is what beam at what point"
    )
    group.add_argument(
        "--reference-channel", metavar="NAME", help="the reference among several: a channel, or NODE+DIR"
    )
    group.add_argument("--frf", choices=CHOICES, help="estimator of responses to random excitation (h1)")
    group.add_argument("--window", choices=WINDOWS, help="window of its segments (hann)")
    group.add_argument("--overlap", type=float, metavar="SHARE", help="of neighbouring segments (0.5)")
    group.add_argument("--averages", type=int, metavar="N", help=f"segments ({AVERAGES})")
    group.add_argument(
        "--resolution", type=float, metavar="HZ", help="spacing of lines, instead of --averages"
    )
    group.add_argument(
        "--period", type=float, metavar="S", help="the excitation repeats itself after so long"
    )
    group.add_argument("--skip-periods", type=int, metavar="N", help="periods left out at the start (1)")
    group.add_argument("--steps", type=Path, metavar="FILE", help="stepped sine: start_s, stop_s, freq_hz")
    group.add_argument(
        "--settle", type=float, metavar="SHARE", help="of each step left out at its start (0.2)"
    )
    group.add_argument("--frf-band", type=_band, metavar="F1-F2", help="lines to keep, Hz")


def _band(text: str) -> tuple[float, float]:
    low, mark, high = text.partition("-")
    try:
        if mark:
            return float(low), float(high)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError("must be two frequencies in Hz like 400-5000")


def series_options(given: argparse.Namespace, described: bool = False) -> SeriesOptions | None:
    """Return what the options of time series say; None when none of them is given.

    Parameters
    ----------
    given : argparse.Namespace
    described : bool
        Whether a file may hold time series that need no ``--channels``.

    Raises
    ------
    KinematicsError
        An option of time series without ``--channels`` where it is needed, or what SeriesOptions says.
    """
    values = {}
    for one in fields(SeriesOptions):
        flag = _FLAGS.get(one.name, f"--{one.name}")
        value = getattr(given, flag[2:].replace("-", "_"))
        if value is not None:
            values[one.name] = value
    faults = []
    if "channels" not in values and not described:
        want = "given with --channels FILE"
        faults = [Fault(_FLAGS.get(name, f"--{name}"), want, "alone") for name in values]
    made = None
    with collecting(faults):
        made = SeriesOptions(**values) if values else None
    raise_all(KinematicsError, faults)
    return made
