"""A cohort of a thousand ears, motion and mass given: time, memory and size of the page.

python benchmarks/cohort_thousand.py [--ears 1000]
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from legacy.pipeline.cohort.cohort_files import write_cohort
from legacy.pipeline.cohort.cohort_laws import cohort_laws
from tests.pipeline.cohort.simulated_ears import ear


def main() -> None:
    """Print the figures."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--ears", type=int, default=1000)
    count = given.parse_args().ears
    rng = np.random.default_rng(1)
    ears = [ear(k, rng) for k in range(count)]
    begun = time.process_time()
    laws = cohort_laws(ears)
    fitted = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        write_cohort(Path(folder), laws, {})
        size = (Path(folder) / "cohort.html").stat().st_size
    written = time.process_time()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    law = laws.law("K11", "mass").law
    print(f"{count} ears, {len(laws.laws)} laws: {fitted - begun:.1f} s of processor time")
    print(f"files: {written - fitted:.1f} s; cohort.html {size / 1e6:.2f} MB; peak memory {memory:.0f} MiB")
    print(f"K11 ~ mass: {law.exponent:.3f} ({law.interval[0]:.3f} to {law.interval[1]:.3f}); planted 2")


if __name__ == "__main__":
    main()
