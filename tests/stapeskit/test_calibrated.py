"""Files of calibrated numbers."""

import pytest

from legacy.stapeskit.calibrated import CalibratedNumbers
from legacy.stapeskit.provenance import content_hash

TEXT = """
[default]
fitted_on = "spheres"
checked_on = "none"
[population.none]
description = "not checked"
script = "none"
date = "none"
[population.spheres]
description = "200 spheres"
script = "spheres.py"
date = "2026-01-01"
[psf.width]
value = 0.5
meaning = "width, voxels"
[psf.range]
value = [0.1, [1, 2]]
meaning = "range"
checked_on = "spheres"
"""


@pytest.fixture
def numbers(tmp_path):
    path = tmp_path / "calibrated.toml"
    path.write_text(TEXT, encoding="utf-8")
    return CalibratedNumbers(path)


def test_values_come_by_name_and_lists_as_tuples(numbers):
    assert numbers("psf.width") == 0.5
    assert numbers("psf.range") == (0.1, (1, 2))
    with pytest.raises(KeyError):
        numbers("psf.other")


def test_populations_default_to_those_of_the_file(numbers):
    assert numbers.entries["psf.width"].fitted_on == "spheres"
    assert numbers.entries["psf.width"].checked_on == "none"
    assert numbers.entries["psf.range"].checked_on == "spheres"
    assert numbers.populations["spheres"].script == "spheres.py"


def test_the_version_is_the_content_hash(numbers, tmp_path):
    ((name, version),) = numbers.version().items()
    path = tmp_path / "calibrated.toml"
    assert name == f"{tmp_path.name}/calibrated.toml"
    assert version == content_hash(path)
    path.write_text(TEXT.replace("0.5", "0.6"), encoding="utf-8")
    assert version != content_hash(path)


def test_an_unknown_field_is_an_error(tmp_path):
    path = tmp_path / "calibrated.toml"
    path.write_text(TEXT + 'sense = "typing error"\n', encoding="utf-8")
    with pytest.raises(TypeError):
        CalibratedNumbers(path)
