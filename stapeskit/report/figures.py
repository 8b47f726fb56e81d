"""Draw figures alike: style, panels with fixed margins, frequency axes, thinned curves, small files.

matplotlib is imported where something is drawn.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array
from stapeskit.report.colours import PAGE_COLOURS
from stapeskit.spatial import DOF_UNITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

Indices = NDArray[np.int64]

RUN_STYLES = ("-", "--", ":", "-.")

# What differs from matplotlib's defaults; a matplotlibrc of the folder, which could run LaTeX, has no say.
_STYLE: Mapping[str, Any] = MappingProxyType(
    {
        "font.sans-serif": ["DejaVu Sans", "Verdana", "sans-serif"],
        "font.size": 9.0,
        "text.color": PAGE_COLOURS["ink"],
        "axes.titlesize": 9.5,
        "axes.titlelocation": "left",
        "axes.titley": 1.0,  # a fixed place: to look for a free one measures every label
        "axes.labelsize": 9.0,
        "axes.labelcolor": PAGE_COLOURS["ink"],
        "axes.edgecolor": "#9aa7b4",
        "axes.linewidth": 0.7,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "grid.color": "#e6eaef",
        "grid.linewidth": 0.7,
        "xtick.bottom": False,
        "ytick.left": False,
        "xtick.color": "#56636f",
        "ytick.color": "#56636f",
        "xtick.labelsize": 8.5,
        "ytick.labelsize": 8.5,
        "lines.linewidth": 1.3,
        "lines.markersize": 3.2,
        "legend.frameon": False,
        "legend.fontsize": 8.5,
        "path.simplify_threshold": 0.25,
        "svg.fonttype": "none",
        "svg.hashsalt": "stapeskit",
    }
)

_IMAGE_DOTS_PER_INCH = 160  # 1.7 pixels for each of a screen of 96 per inch


@contextmanager
def style() -> Iterator[None]:
    """Draw in the style of this project, whatever the user's settings are: also as decorator ``@style()``."""
    import matplotlib

    kept = {"backend", "backend_fallback", "interactive", "toolbar", "timezone", "date.epoch"}
    now, wanted = matplotlib.rcParams, dict[Any, Any](matplotlib.rcParamsDefault) | dict(_STYLE)
    with matplotlib.rc_context({k: v for k, v in wanted.items() if k not in kept and now[k] != v}):
        yield


def panels(
    rows: int = 1,
    columns: int = 1,
    *,
    width: float = 10.4,
    height: float = 2.5,
    margins: tuple[float, float, float, float] = (0.62, 0.12, 0.3, 0.46),
    gaps: tuple[float, float] = (0.68, 0.62),
    share_x: bool = False,
) -> tuple[Figure, NDArray[Any]]:
    """Return a figure and its axes (rows, columns), laid out by fixed margins; use it within `style`.

    Fixed margins cost nothing; matplotlib's layout engines draw the figure twice. All lengths are inches:
    the height of one row with its gap, margins left, right, top, bottom, gaps between columns (room for the
    labels along y) and rows. With ``share_x`` only the lowest row has labels along x.
    """
    from stapeskit.report.shown_figure import ShownFigure

    left, right, top, bottom = margins
    across, between = gaps[0], 0.38 if share_x else gaps[1]
    inner_width = (width - left - right - (columns - 1) * across) / columns
    inner_height = height - between
    total = top + bottom + rows * inner_height + (rows - 1) * between
    drawing = ShownFigure(figsize=(width, total))
    layout = {
        "left": left / width,
        "right": 1.0 - right / width,
        "top": 1.0 - top / total,
        "bottom": bottom / total,
        "wspace": across / inner_width,
        "hspace": between / inner_height,
    }
    axes = drawing.subplots(rows, columns, squeeze=False, sharex=share_x, gridspec_kw=layout)
    return drawing, axes


def draw(drawing: Figure) -> str:
    """Return a figure as SVG to stand within a page; what is ``rasterized`` in it is an image."""
    stream = io.BytesIO()
    with style():
        drawing.savefig(stream, format="svg", dpi=_IMAGE_DOTS_PER_INCH, metadata={"Date": None})
    return _compact(stream.getvalue()).decode()


def save_figures(
    command: str, figures: Mapping[str, Figure], folder: Path, force: bool = False
) -> list[Path]:
    """Write figures by name as PDF and SVG into a folder, whole or not at all; return their paths."""
    from stapeskit.outputs import Outputs

    names = [f"{name}.{kind}" for name in figures for kind in ("pdf", "svg")]
    outputs = Outputs(command, Path(folder), names, (), force)
    with outputs.staged() as stage, style():
        for name in names:
            figures[Path(name).stem].savefig(stage / name)
    return [outputs.folder / name for name in names]


_LONG_NUMBER = re.compile(rb"(\d+\.\d\d)\d+")
_PATH = re.compile(rb' d="[^"]*"')
_IDS = re.compile(rb'(id="|url\(#|xlink:href="#)')
_DROPPED = re.compile(rb"<\?xml.*?\?>|<!DOCTYPE.*?>|<!--.*?-->|<metadata>.*?</metadata>", re.DOTALL)


def _compact(svg: bytes) -> bytes:
    """Make the ids of an SVG its own, and round its paths to hundredths of a point: finer than printers."""
    from hashlib import sha256

    body = _DROPPED.sub(b"", svg)
    body = _PATH.sub(lambda match: _LONG_NUMBER.sub(rb"\1", match[0]).replace(b"\n", b""), body)
    body = re.sub(rb"\n\s*", b"\n", body).strip()
    own = b"f" + sha256(body).hexdigest()[:10].encode() + b"-"
    return _IDS.sub(rb"\1" + own, body)


def frequency_axis(axes: Axes, freq_hz: Array, *, label: bool = True) -> None:
    """Make the frequency axis (kHz), logarithmic when the ascending lines are spaced that way."""
    if label:
        axes.set_xlabel("frequency (kHz)")
    low, high = float(freq_hz[0]) / 1e3, float(freq_hz[-1]) / 1e3
    if log_spaced(freq_hz):
        axes.set_xscale("log")
        _plain_ticks(axes.xaxis, (1.0, 2.0, 5.0) if high < 30.0 * low else (1.0,))
    if low < high:
        axes.set_xlim(low, high)


def amplitude_axis(axes: Axes, low: float, high: float) -> None:
    """Make an axis of amplitudes logarithmic between two positive values, with plain numbers at its ticks."""
    if not 0.0 < low < high < np.inf:
        return
    axes.set_yscale("log")
    decades = np.log10(high / low)
    steps = (1.0, 2.0, 5.0) if decades < 1.7 else (1.0, 3.0) if decades < 2.7 else (1.0,)
    _plain_ticks(axes.yaxis, steps)
    axes.set_ylim(low / 10.0 ** (0.04 * decades), high * 10.0 ** (0.06 * decades))


def _plain_ticks(axis: Axis, steps: Sequence[float]) -> None:
    """Write plain numbers at some steps of each decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=steps, numticks=8))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))


def log_spaced(freq_hz: Array) -> bool:
    """Return whether lines are spaced more evenly on a logarithmic axis than on a linear one."""
    if len(freq_hz) < 4 or freq_hz[0] <= 0.0:
        return False
    step, ratio = np.diff(freq_hz), np.diff(np.log(freq_hz))
    return bool(np.std(ratio) / np.mean(ratio) < np.std(step) / np.mean(step))


def decimate_lines(size: Array, most: int = 400) -> Indices:
    """Return ascending indices of at most ``most`` lines of what is drawn, (lines,); NaN where missing.

    Of each of most / 2 groups of neighbours the smallest and the largest stay: every peak and trough.
    """
    if len(size) <= most:
        return np.arange(len(size))
    high, low = np.where(np.isnan(size), -np.inf, size), np.where(np.isnan(size), np.inf, size)
    kept = [0, len(size) - 1]
    for group in np.array_split(np.arange(len(size)), (most - 2) // 2):
        kept += [group[np.argmax(high[group])], group[np.argmin(low[group])]]
    return np.unique(kept)


def dof_unit(name: str, per_reference: str = "") -> tuple[float, str]:
    """Return factor from SI and unit in which a degree of freedom is drawn.

    >>> dof_unit("y"), dof_unit("gamma", "base:y")
    ((1000000000.0, 'nm'), (1.0, 'rad/m'))
    """
    base = DOF_UNITS[name]
    if per_reference:
        reference = DOF_UNITS[per_reference.rpartition(":")[2]]
        return 1.0, "1" if reference == base else f"{base}/{reference}"
    return (1e9, "nm") if base == "m" else (1e6, "µrad")


def plain(name: str) -> str:
    """Escape ``$`` in a name, which would begin a formula in matplotlib."""
    return name.replace("$", r"\$")


def shorten_name(name: str, most: int = 16) -> str:
    """Return a name of at most ``most`` letters: its beginning and its end.

    >>> shorten_name("head", 8), shorten_name("measurement point 12", 9)
    ('head', 'meas…t 12')
    """
    if len(name) <= most:
        return name
    end = (most - 1) // 2
    return f"{name[: most - 1 - end]}…{name[len(name) - end :]}"
