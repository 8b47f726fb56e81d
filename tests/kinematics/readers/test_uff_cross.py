"""Cross and auto spectra in universal files become frequency responses with their coherence."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.readers.uff.spectra import read
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics import written_uff as uff

F = np.arange(1, 41) * 25.0
RNG = np.random.default_rng(5)
AVERAGES = 50
DRIVE = RNG.normal(size=(AVERAGES, 40, 2)) @ [1.0, 1.0j]
H = (RNG.normal(size=(40, 2)) @ [1.0, 1.0j]) * 1e-3
ANSWER = H * DRIVE + 2e-4 * (RNG.normal(size=(AVERAGES, 40, 2)) @ [1.0, 1.0j])
GXX = np.mean(np.abs(DRIVE) ** 2, axis=0)
GYY = np.mean(np.abs(ANSWER) ** 2, axis=0)
GYX = np.mean(ANSWER * DRIVE.conj(), axis=0)


def cross(value=GYX, unit="(m/s)*N", quantity=uff.VELOCITY, **how):
    given = {"kind": uff.CROSS, "form": 6, "reference": (9, 1), **how}
    return uff.function(F, value, 1, 3, quantity=quantity, unit=unit, **given)


def auto(value, node, direction, quantity, unit, **how):
    return uff.function(F, value, node, direction, kind=uff.AUTO, form=4, quantity=quantity, unit=unit, **how)


def drive(unit="N^2", **how):
    return auto(GXX, 9, 1, uff.FORCE, unit, **how)


def written(tmp_path, *parts):
    path = tmp_path / "spectra.uff"
    path.write_bytes(b"".join([uff.units(), *parts]))
    return path


def test_cross_over_auto_with_coherence(tmp_path):
    (one,) = read(written(tmp_path, cross(), drive(), auto(GYY, 1, 3, uff.VELOCITY, "(m/s)^2"))).recordings
    # Bendat and Piersol's H1 and its coherence, from the averages that were written.
    np.testing.assert_allclose(one.value, GYX / GXX, rtol=1e-10)
    np.testing.assert_allclose(one.coherence, np.abs(GYX) ** 2 / GXX / GYY, rtol=1e-10)
    assert np.max(np.abs(one.value - H)) < 5.0 * 2e-4 / np.sqrt(AVERAGES)
    assert (one.point, one.per, one.order, one.direction.tolist()) == ("1", "N", 1, [0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("spectrum", "response", "quantity", "scale", "order"),
    [
        ("NONE", None, uff.VELOCITY, 1.0, 1),
        ("mm/s*N", None, uff.VELOCITY, 1e-3, 1),
        ("NONE", "mm2/s2", uff.VELOCITY, 1e-3, 1),
        ("anything", "(um)^2", uff.DISPLACEMENT, 1e-6, 0),
        ("NONE", "(m/s2)^2", uff.ACCELERATION, 1.0, 2),
        ("NONE", "mm2/s4", 0, 1e-3, 2),
        ("NONE", "g*g", 0, 9.80665, 2),
    ],
)
def test_units_of_power(spectrum, response, quantity, scale, order, tmp_path):
    parts = [cross(unit=spectrum, quantity=quantity), drive()]
    parts += [] if response is None else [auto(GYY, 1, 3, quantity, response)]
    (one,) = read(written(tmp_path, *parts)).recordings
    np.testing.assert_allclose(one.value, scale * GYX / GXX, rtol=1e-10)
    assert one.order == order
    assert (one.coherence is None) == (response is None)


def test_spectra_that_give_no_response_are_left_out(tmp_path):
    lonely = written(tmp_path, cross())
    with pytest.raises(StapeskitError, match="got 1 cross spectrum"):
        read(lonely)
    no_power = written(tmp_path, cross(), drive("N"))
    with pytest.raises(StapeskitError, match="got 1 cross spectrum, 1 auto spectrum"):
        read(no_power)
    response = uff.function(F, H, 1, 3, form=6, reference=(9, 1), per=uff.FORCE, per_unit="N")
    made = read(written(tmp_path, cross(), drive(), response))
    np.testing.assert_allclose(made.recordings[0].value, H, rtol=1e-10)
    assert "1 cross spectrum, 1 auto spectrum" in made.notices[0].text


def test_spectra_of_different_scale_are_refused(tmp_path):
    louder = np.where(np.arange(len(F)) == len(F) // 2, 3.0, 1.0)
    path = written(tmp_path, cross(louder * GYX), drive(), auto(GYY, 1, 3, uff.VELOCITY, "(m/s)^2"))
    with pytest.raises(StapeskitError, match=r"of one scale; got a coherence of 8.*datasets 2, 3 and 4"):
        read(path)
