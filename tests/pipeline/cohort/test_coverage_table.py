"""docs/cohort_coverage.md, made by benchmarks/cohort_laws.py: intervals hold as often as claimed."""

import re
from pathlib import Path

import pytest
from scipy.stats import binom

PAGE = Path(__file__).parents[3] / "docs" / "cohort_coverage.md"


def rows(number=0):
    """Return the rows of a table of populations as dictionaries."""
    lines = PAGE.read_text(encoding="utf-8").replace("\n<!-- end -->", "").split("\n\n")
    table = [part for part in lines if part.startswith("| population")][number].splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    return [dict(zip(cells[0], row, strict=True)) for row in cells[2:]]


@pytest.mark.parametrize("row", rows(), ids=lambda row: f"{row['population']}, {row['n']}")
def test_intervals_hold_as_often_as_claimed(row):
    """A share as low would be seen once in 1000 such tables if the claim holds."""
    count = int(row["cohorts"])
    heavy = row["population"] == "heavy tails"

    def least(share):
        return binom.ppf(0.001 / 24, count, share) / count

    assert float(row["exponent"]) >= least(0.91 if heavy else 0.94)
    if not heavy:
        assert float(row["scatter"]) >= least(0.94)
    if row["prediction"] != "–":
        assert float(row["prediction"]) >= least(0.94)


@pytest.mark.parametrize("row", rows(1), ids=lambda row: f"{row['population']}, {row['n']}")
def test_normal_ranges_and_predictions_hold_as_often_as_claimed(row):
    count = int(row["cohorts"])
    for name in ("range, true", "prediction, true"):
        assert float(row[name]) >= binom.ppf(0.001 / 48, count, 0.94) / count, name


def test_exponents_have_no_bias_worth_the_name():
    """An estimate may be off by what its own table leaves open, 3 standard errors of 0.15 at most."""
    for row in rows(2):
        assert abs(float(row["bias / sd"])) <= 0.15 + 3.0 * float(row["standard error"]), row["population"]


def test_every_population_is_there_at_every_size():
    names = {row["population"] for row in rows()}
    assert len(names) == 8
    assert len(rows()) == 24


def test_findings_without_a_law_are_as_rare_as_claimed():
    text = PAGE.read_text(encoding="utf-8")
    number = int(re.search(r"no law, (\d+) cohorts", text)[1])
    for size, share in re.findall(r"\| (\d+) \| (0\.\d+) \| 0\.\d\d \|", text.split("72 dependent")[1]):
        assert float(share) <= binom.ppf(0.999, number, 0.11) / number, size
