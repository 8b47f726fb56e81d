"""Mode shapes on the footplate, correlations, and what is published beside the fit."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.fitting.fit_kd import fit_kd
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.model.annular_ligament import ellipse_mm
from legacy.fitting.model.model import modes
from legacy.fitting.options import KDOptions
from legacy.fitting.report.figures import correlation_figure
from legacy.fitting.report.mode_shapes import shape_figure
from legacy.fitting.report.modes_section import modes_section
from tests.fitting.cases import M, paper_motion


@pytest.fixture(scope="module")
def fit() -> KDFit:
    return fit_kd(paper_motion(0.02, 0), M, KDOptions(bands=0))


def nodal_line(axis) -> np.ndarray:
    """Return the vertices of the one contour of an axis."""
    lines = [
        path.vertices for held in axis.collections for path in held.get_paths() if hasattr(held, "levels")
    ]
    return np.concatenate(lines)


def test_rocking_about_a_shifted_axis_has_its_nodal_line_there() -> None:
    """K = c r r^T springs: rocking about z through x = -0.3 mm leaves the footplate at rest on that line."""
    mass = np.diag([3e-6, 8e-12, 9e-12])
    arm = np.array([[1.0, 0.0, -3e-4], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    uncoupled = np.diag([3e6, 8e-3, 9e-2])
    moved = arm.T @ mass @ arm
    found = modes(moved, arm.T @ uncoupled @ arm, np.zeros((3, 3)))
    figure = shape_figure(found, ellipse_mm(2.8, 1.3))
    place = next(k for k, mode in enumerate(found.pairs) if np.argmax(np.abs(mode.shape)) == 2)
    line = nodal_line(figure.axes[place])
    assert line[:, 0] == pytest.approx(-0.3, abs=0.02)


def test_the_section_has_every_mode_and_the_published_numbers(fit: KDFit) -> None:
    text = "".join(str(block) for block in modes_section(fit, None).blocks)
    assert "1238 ± 973" in text
    assert "833" in text
    assert "0.018" in text
    assert text.count("damped (Hz)") >= 4
    assert "nodal line" in text
    other = fit_kd(paper_motion(0.02, 0), M[:2, :2], KDOptions(dof=("y", "alpha"), bands=0))
    assert "nodal line" not in "".join(str(block) for block in modes_section(other, None).blocks)


def test_correlations_are_in_percent_with_100_on_the_diagonal(fit: KDFit) -> None:
    axis = correlation_figure(fit.covariance, fit.parameters).axes[0]
    shown = np.array([float(text.get_text()) for text in axis.texts]).reshape(12, 12)
    assert np.all(np.diag(shown) == 100.0)
    assert np.array_equal(shown, shown.T)
    assert np.abs(shown).max() == 100.0
