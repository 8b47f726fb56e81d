"""The scripts of docs/examples print the known numbers of the paper and of its beam."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from fitting.model import principal_axes

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"


def script(name):
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def paper():
    return script("paper")


@pytest.fixture(scope="module")
def beam():
    return script("beam")


def test_printed_damping_is_a_misprint(paper):
    is_passive, growth = paper.printed_damping()
    assert not is_passive
    assert growth == pytest.approx(1.09e5, rel=5e-3)


def test_table_2_follows_from_the_corrected_matrices(paper):
    damped, undamped, ratios, shapes = paper.table_2()
    assert damped == pytest.approx([1750.7, 2780.4, 3861.1], abs=0.05)
    assert undamped == pytest.approx([1764.1, 2807.9, 3912.3], abs=0.05)
    assert ratios == pytest.approx([0.123, 0.140, 0.161], abs=5e-4)
    assert np.all(np.abs(damped - paper.FREQUENCY_HZ) < 4.0)
    # printed with two or three digits; the units nm and urad are those of no amplitude
    assert np.all(np.abs(shapes / paper.SHAPES - 1.0) < 0.015)


def test_principal_axes_and_centre_of_mass(paper):
    x0, z0, angle, *stiffness = principal_axes(paper.STIFFNESS)
    assert [1e3 * x0, 1e3 * z0] == pytest.approx([-0.2787, -0.2404], abs=5e-5)
    assert np.degrees(angle) == pytest.approx(1.231, abs=5e-4)
    assert stiffness == pytest.approx([1722.0, 1.2694e-3, 3.6573e-3], rel=1e-4)
    together = principal_axes(np.stack([paper.STIFFNESS, 2.0 * np.array(paper.STIFFNESS)]))
    assert together[1, :3] == pytest.approx(together[0, :3])
    assert paper.centre_of_mass_mm() == pytest.approx([0.0447, 0.1359], abs=5e-5)


def test_the_paper_prints(paper, capsys):
    paper.main()
    assert len(capsys.readouterr().out.splitlines()) == 13


def test_stiffness_and_masses_of_the_beam(beam):
    c1, c2, c3 = beam.tip_stiffness()[np.triu_indices(2)] * [1e-3, 1.0, 1e3]
    assert (c1, c2, c3) == pytest.approx((10.0914, 242.195, 7750.2), rel=1e-5)
    mass = beam.cube_mass()
    assert 1e3 * mass[0, 0] == pytest.approx(8.49, abs=5e-3)
    assert 1e9 * mass[1, 1] == pytest.approx(365.5, abs=0.05)
    assert pytest.approx(3.05, abs=5e-3) == 1e3 * beam.BEAM_KG


def test_mass_of_the_beam_and_place_of_the_cube_change_the_frequencies(beam):
    massless = beam.frequencies_hz(beam.tip_stiffness(), beam.cube_mass())
    change = 100.0 * (beam.clamped_frequencies_hz() / massless - 1.0)
    assert -4.0 < change[0] < -3.0
    assert -20.0 < change[1] < -10.0
    shifted = beam.frequencies_hz(beam.tip_stiffness(), beam.cube_mass(1e-4))
    assert 100.0 * (shifted / massless - 1.0) == pytest.approx([-0.3, 0.3], abs=0.02)


def test_fits_of_the_beam(beam):
    assert np.all(np.abs(beam.deviations_percent(beam.measured(False, 1e-3))) < 0.1)
    heavy = beam.measured(True, 1e-3)
    assert np.all(beam.deviations_percent(heavy, estimator="pinv") < -4.0)
    assert np.all(np.abs(beam.deviations_with_beam_mass(heavy)) < 2.5)
