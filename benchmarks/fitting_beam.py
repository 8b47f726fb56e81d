"""The beam experiment: deviations (Eq. 9) by model and estimator, frequencies, misalignment, as markdown.

Truth is a finite-element beam between two steel cubes (fitting.examples.beam_experiment).
Run: python benchmarks/fitting_beam.py [repetitions].
"""

from __future__ import annotations

import sys

from legacy.fitting.estimators import ESTIMATORS
from legacy.fitting.examples.beam_experiment import MODELS, Setup, deviations
from legacy.fitting.examples.beam_page import SHIFT_M, frequency_rows, rows_of


def show(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """Print a markdown table."""
    print("\n| " + " | ".join(header) + " |\n|" + "-|" * len(header))
    for row in rows:
        print("| " + " | ".join(row) + " |", flush=True)


def main(repetitions: int) -> None:
    """Print the tables."""
    full, massless = Setup(), Setup(beam_has_mass=False)
    show(("", "f1 (Hz)", "f2 (Hz)", "f1 (%)", "f2 (%)"), frequency_rows(full, massless))
    header = ("model", "estimator", "c1 (%)", "c2 (%)", "c3 (%)", "Eq. 9 (%)", "chi2 per dof")
    print(f"\nBeam with mass, {repetitions} repetitions")
    show(header, rows_of([deviations(full, m, e, repetitions) for m in MODELS for e in ESTIMATORS]))
    print("\nCentre of mass believed 100 um off: massless truth and model, then beam with mass and its model")
    cases = [(massless, "massless"), (full, "condensed")]
    show(
        header,
        rows_of([deviations(s, m, e, repetitions, SHIFT_M) for s, m in cases for e in ("ml", "pinv")]),
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
