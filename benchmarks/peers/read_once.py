"""Map the file and add up its voxels: nobody who reads the whole scan once can be faster."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np


def main(scan: str) -> None:
    """Run."""
    values = np.memmap(scan, dtype=np.uint64, mode="r", shape=(_words(scan),))
    parts = np.array_split(values, 64)
    with ThreadPoolExecutor(2) as pool:
        print(sum(int(part) for part in pool.map(np.bitwise_xor.reduce, parts)))


def _words(scan: str) -> int:
    from pathlib import Path

    return Path(scan).stat().st_size // 8


if __name__ == "__main__":
    main(sys.argv[1])
