"""A figure is laid out once, where the layout engine of matplotlib would place it."""

import numpy as np
import pytest

from legacy.stapeskit.page.drawings import amplitude_axis
from legacy.stapeskit.page.layout import lay_out
from legacy.stapeskit.page.page import new_figure


def spectra(figure):
    axes = figure.subplots(3, 2, sharex=True)
    freq = np.linspace(0.4, 5.0, 200)
    for amplitude, phase in axes:
        response = 1e-6 / (1.0 - (freq / 2.0) ** 2 + 0.1j)
        amplitude.plot(freq, np.abs(response), label="a response")
        amplitude_axis(amplitude)
        amplitude.set_ylabel("amplitude (m)")
        phase.plot(freq, np.degrees(np.angle(response)))
        phase.set_title("phase")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center")


def outlines(figure):
    """Axes of equal scale shrink, and have other ticks, when they are placed."""
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    for view in axes.ravel():
        view.plot([-1.2, 1.3], [-0.6, 0.6])
        view.set_aspect("equal")
        view.set_title("a mode")
    axes[0, 0].set_ylabel("z (mm)")
    figure.colorbar(axes[0, 0].scatter([0.0, 1.0], [0.0, 0.1], c=[0.0, 1.0]), ax=axes, shrink=0.8)


@pytest.mark.parametrize("draw", [spectra, outlines])
def test_axes_stand_where_the_engine_places_them_and_nothing_is_cut_off(draw):
    figure, expected = new_figure(9.0, 4.0), new_figure(9.0, 4.0)
    draw(figure)
    draw(expected)
    lay_out(figure)
    expected.get_layout_engine().execute(expected)
    assert figure.get_layout_engine() is None
    for axes, other in zip(figure.axes, expected.axes, strict=True):
        assert np.allclose(axes.get_position().extents, other.get_position().extents, atol=0.008)
        around = axes.get_tightbbox().extents
        assert np.all(around[:2] >= 0.0)
        assert np.all(around[2:] <= figure.bbox.extents[2:])
