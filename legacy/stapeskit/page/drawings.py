"""What the figures of a rigid-motion fit share: colours, names that fit, thinning that keeps peaks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from legacy.stapeskit.arrays import Array
from legacy.stapeskit.spatial import DOF_UNITS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

Indices = NDArray[np.int64]
COLOURS = ("#0b6e99", "#c2571a", "#3f8f4f", "#7a4fa3", "#8a6d1f", "#4d4d4d")
FAULT = "#c81e3a"
INK = "#1d2733"
GRID = "#e6e9ee"
RUN_STYLES = ("-", "--", ":", "-.")


def colour(body: int) -> str:
    """Return the colour of a body by its number."""
    return COLOURS[body % len(COLOURS)]


def shorten_name(name: str, most: int = 16) -> str:
    """Return a name of at most ``most`` letters: its beginning and its end.

    Examples
    --------
    >>> shorten_name("head", 8), shorten_name("measurement point 12", 9)
    ('head', 'meas…t 12')
    """
    if len(name) <= most:
        return name
    end = (most - 1) // 2
    return f"{name[: most - 1 - end]}…{name[len(name) - end :]}"


def distinct_short_names(names: Sequence[str], most: int = 10) -> dict[str, str]:
    """Return short forms of names that remain distinct: long names lose what all of them share.

    Examples
    --------
    >>> distinct_short_names(["point 1 on the plate", "point 12 on the plate"])
    {'point 1 on the plate': '1', 'point 12 on the plate': '12'}
    """
    several = list(dict.fromkeys(names))
    if len(several) < 2 or max(len(name) for name in several) <= most:
        return {name: shorten_name(name, most) for name in several}
    words = [name.replace("_", " ").split(" ") for name in several]
    fewest = min(len(parts) for parts in words)
    first = next((k for k in range(fewest) if len({parts[k] for parts in words}) > 1), 0)
    last = next((k for k in range(fewest - first) if len({parts[-1 - k] for parts in words}) > 1), 0)
    distinct = [" ".join(parts[first : len(parts) - last]) for parts in words]
    if len(set(distinct)) < len(distinct) or not all(distinct):
        distinct = several
    return {name: shorten_name(short, most) for name, short in zip(several, distinct, strict=True)}


def plain(name: str) -> str:
    """Escape ``$`` in a name, which would begin a formula in matplotlib."""
    return name.replace("$", r"\$")


def unit(name: str, per_reference: str = "") -> tuple[float, str]:
    """Return factor and unit in which a degree of freedom is drawn."""
    base = DOF_UNITS[name]
    if per_reference:
        reference = DOF_UNITS[per_reference.rpartition(":")[2]]
        return 1.0, "1" if reference == base else f"{base}/{reference}"
    return (1e9, "nm") if base == "m" else (1e6, "µrad")


def log_spaced(freq_hz: Array) -> bool:
    """Return whether lines are spaced more evenly on a logarithmic axis than on a linear one."""
    if len(freq_hz) < 4 or freq_hz[0] <= 0.0:
        return False
    step, ratio = np.diff(freq_hz), np.diff(np.log(freq_hz))
    return bool(np.std(ratio) / np.mean(ratio) < np.std(step) / np.mean(step))


def frequency_axis(view: Axes, freq_hz: Array) -> None:
    """Name the frequency axis (kHz), logarithmic when the lines are spaced that way."""
    view.set_xlabel("frequency (kHz)")
    if log_spaced(freq_hz):
        from matplotlib.ticker import LogFormatter, LogLocator

        view.set_xscale("log")
        view.xaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0)))
        view.xaxis.set_major_formatter(LogFormatter(labelOnlyBase=False, minor_thresholds=(9.0, 0.5)))
        view.xaxis.set_minor_formatter("")
    low, high = freq_hz[0] / 1e3, freq_hz[-1] / 1e3
    if low < high:
        view.set_xlim(low, high)


def line_words(freq_hz: Array) -> str:
    """Return how many lines there are, and where.

    Examples
    --------
    >>> line_words(np.array([100.0, 200.0])), line_words(np.array([862.3]))
    ('2, 100 to 200 Hz', '1, at 862.3 Hz')
    """
    low, high = f"{freq_hz[0]:.6g}", f"{freq_hz[-1]:.6g}"
    return f"{len(freq_hz)}, {low} to {high} Hz" if len(freq_hz) > 1 else f"1, at {low} Hz"


def amplitude_axis(view: Axes, most_minor: float = 0.4) -> None:
    """Make an axis of amplitudes logarithmic, with plain numbers at its ticks.

    Parameters
    ----------
    most_minor : float
        Decades up to which all ticks between powers of ten have numbers; see matplotlib's LogFormatter.
    """
    from matplotlib.ticker import LogFormatter

    class Plain(LogFormatter):
        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    view.set_yscale("log")
    view.yaxis.set_major_formatter(Plain(labelOnlyBase=False))
    view.yaxis.set_minor_formatter(Plain(labelOnlyBase=False, minor_thresholds=(2.0, most_minor)))


def decimate_lines(size: Array, most: int) -> Indices:
    """Return ascending indices of at most ``most`` lines that keep every peak and every trough.

    Parameters
    ----------
    size : ndarray, (freq,)
        What is drawn; NaN where missing.
    most : int
        Lines are put into most / 2 groups of neighbours; of each the smallest and the largest stay.
    """
    lines = len(size)
    if lines <= most:
        return np.arange(lines)
    edges = np.linspace(0, lines, max(1, most // 2) + 1).round().astype(int)
    high, low = np.where(np.isnan(size), -np.inf, size), np.where(np.isnan(size), np.inf, size)
    width = int(np.max(np.diff(edges)))
    columns = np.minimum(edges[:-1, None] + np.arange(width), edges[1:, None] - 1)
    rows = np.arange(len(columns))
    tops = columns[rows, np.argmax(high[columns], axis=1)]
    bottoms = columns[rows, np.argmin(low[columns], axis=1)]
    return np.unique(np.concatenate([[0, lines - 1], tops, bottoms]))


def run_label(body: str, run: str, runs: int) -> str:
    """Return the name of a curve."""
    name = shorten_name(plain(body), 34)
    return f"{name}, run {shorten_name(plain(run), 20)}" if runs > 1 else name
