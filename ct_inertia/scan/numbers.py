"""Numbers in the names of slices: their series, and the gaps in it."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ct_inertia.scan.stored import Stored
from stapeskit.faults import list_some


def numbered(images: Sequence[Path]) -> dict[str, list[tuple[int, Path]]]:
    """Return number and file of the slices of each series, by its name with ``#`` in place of the number.

    Of names that differ in numbers only, the last number that differs counts the slices: ``ear_0042_8bit``
    counts by its first one. A name without a number is no slice.
    """
    alike = defaultdict(list)
    for path in images:
        words = re.split(r"(\d+)", path.stem)  # every second one is a number
        if len(words) > 1:
            alike[tuple(words[::2]), path.suffix.lower()].append((words, path))
    series: dict[str, list[tuple[int, Path]]] = defaultdict(list)
    for (_, ending), group in alike.items():
        places = range(1, len(group[0][0]), 2)
        at = max((k for k in places if len({words[k] for words, _ in group}) > 1), default=places[-1])
        for words, path in group:
            name = "".join([*words[:at], "#", *words[at + 1 :], ending])
            series[name].append((int(words[at]), path))
    return series


def note_gaps(stored: Stored, numbers: Sequence[int], name: str) -> None:
    """Report numbers, ascending, that are left out of those of the slices, or all but every n-th."""
    step = Counter(np.diff(numbers).tolist()).most_common(1)[0][0]
    missing = sorted(set(range(numbers[0], numbers[-1] + 1, step)) - set(numbers))
    if missing:
        text = (
            f"{len(missing)} slices are missing in {name} (number {list_some(map(str, missing), 5)}): the "
            f"slices around each gap are taken as neighbours, which shortens the body there."
        )
        stored.note(text, "slices_missing")
    elif step > 1:
        stored.note(
            f"The slices in {name} are numbered in steps of {step}: where the others were left out, the "
            f"distance of slices is {step} times that of the scan."
        )
