"""The numbers printed in the paper, recomputed."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.examples import paper
from legacy.fitting.examples.paper_page import main, paper_page
from legacy.fitting.model.model import modes, passive, simulate
from legacy.fitting.model.principal_axes import principal_axes


def test_printed_damping_is_unstable_and_not_passive() -> None:
    found = modes(paper.PAPER_MASS, paper.PAPER_STIFFNESS, paper.PAPER_DAMPING_PRINTED)
    assert not found.stable
    assert found.max_real_1_s == pytest.approx(1.09e5, rel=0.005)
    assert not passive(paper.PAPER_DAMPING_PRINTED)


def test_corrected_damping_restores_table_2() -> None:
    found = modes(paper.PAPER_MASS, paper.PAPER_STIFFNESS, paper.PAPER_DAMPING_CORRECTED)
    assert found.stable
    assert passive(paper.PAPER_DAMPING_CORRECTED)
    assert [mode.frequency_hz for mode in found.pairs] == pytest.approx([1750.7, 2780.4, 3861.1], abs=0.05)
    undamped = [mode.undamped_frequency_hz for mode in found.pairs]
    assert undamped == pytest.approx([1764.1, 2807.9, 3912.3], abs=0.06)
    assert [mode.damping_ratio for mode in found.pairs] == pytest.approx([0.123, 0.140, 0.161], abs=5e-4)
    for mode, printed in zip(found.pairs, paper.TABLE_2_FREQUENCY_HZ, strict=True):
        assert mode.frequency_hz == pytest.approx(printed, rel=0.002)
    shapes = np.array([np.abs(mode.shape) for mode in found.pairs]) * paper.TABLE_2_SHAPE_SCALE
    recomputed = [[33.48, 90.1, 4.66], [33.45, 9.27, 55.9], [164.6, 25.2, 31.9]]
    assert np.allclose(shapes, recomputed, rtol=2e-3)
    assert np.allclose(shapes, paper.TABLE_2_SHAPE, rtol=0.02)


def test_principal_axes_of_the_printed_stiffness() -> None:
    found = principal_axes(paper.PAPER_STIFFNESS)
    assert found.origin_x_m * 1e3 == pytest.approx(-0.2787, abs=5e-5)
    assert found.origin_z_m * 1e3 == pytest.approx(-0.2404, abs=5e-5)
    assert np.degrees(found.angle_rad) == pytest.approx(1.231, abs=5e-4)
    assert found.stiffness == pytest.approx([1722.0, 1.2694e-3, 3.6573e-3], rel=4e-5)
    assert found.stiffness == pytest.approx(paper.PAPER_PRINCIPAL_STIFFNESS, rel=0.01)


def test_centre_of_mass_of_the_printed_mass_matrix() -> None:
    mass = paper.PAPER_MASS
    assert mass[0, 2] / mass[0, 0] * 1e3 == pytest.approx(0.0447, abs=5e-5)
    assert -mass[0, 1] / mass[0, 0] * 1e3 == pytest.approx(0.1359, abs=5e-5)


def test_piston_motion_leads_at_low_frequency_and_peaks_near_the_third_mode() -> None:
    freq = np.linspace(*paper.PAPER_BAND_HZ, 500)
    base = np.zeros((500, 3), dtype=complex)
    base[:, 0] = 1.0
    gain = np.abs(
        simulate(paper.PAPER_MASS, paper.PAPER_STIFFNESS, paper.PAPER_DAMPING_CORRECTED, freq, base)[:, 0]
    )
    assert gain[0] == pytest.approx(1.0, abs=0.05)
    assert 3500.0 < freq[np.argmax(gain)] < 3950.0


def test_page_states_the_misprint_and_every_section() -> None:
    html = paper_page().html()
    for words in ("UNSTABLE", "NOT PASSIVE", "1750.7", "2780.4", "3861.1", "-0.2787", "1.231", "10.0914"):
        assert words in html
    assert "http" not in html.replace("http://www.w3.org", "").replace("http-equiv", "")


def test_page_is_written_by_its_command(tmp_path, capsys) -> None:
    assert main([str(tmp_path / "new" / "paper.html")]) == 0
    assert (tmp_path / "new" / "paper.html").stat().st_size > 50_000
    assert main([]) == 2
    assert "usage" in capsys.readouterr().err
