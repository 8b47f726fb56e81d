"""A soft coat on bone: its image against the closed form of a shell, its options, its notice."""

import numpy as np
import pytest

from benchmarks.population import row_named, score
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.grey.soft_coat import Coat, coat_image, stated_coat
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.volume.grid_operations import gaussian

H, RADIUS, THICK, GREY, AIR, BONE = 0.02, 0.4, 0.035, 0.15, 200.0, 1200.0


def coated_ball():
    """Grey values of a ball with a coat, blurred, and the blur."""
    place = (np.indices((56, 56, 56)) - 27.6) * H
    distance = np.linalg.norm(place, axis=0)

    def ball(radius):
        return np.clip(0.5 + (radius - distance) / H, 0.0, 1.0)

    share = ball(RADIUS) + GREY * (ball(RADIUS + THICK) - ball(RADIUS))
    sigma = 1.2 * H
    image = gaussian(share.astype(np.float32), np.sqrt(1.2**2 - 1 / 12))
    return (AIR + (BONE - AIR) * image).astype(np.float32), distance, sigma


def image_of(coat):
    grey, distance, sigma = coated_ball()
    nothing = np.zeros(grey.shape, dtype=bool)
    cut = Cut(np.zeros(3, dtype=np.int64), grey, distance < RADIUS, nothing, nothing, "")
    near = distance < RADIUS + 0.13
    return coat_image(cut, coat, near, np.full(3, H), (AIR, BONE), sigma)


def test_the_image_of_a_coat_holds_the_volume_of_the_shell():
    found = image_of(Coat(THICK, 0.01, GREY, 0.05))
    shell = GREY * 4 / 3 * np.pi * ((RADIUS + THICK) ** 3 - RADIUS**3)
    assert found.share.sum() * H**3 == pytest.approx(shell, rel=0.03)
    by_thickness = GREY * 4 * np.pi * (RADIUS + THICK) ** 2 * 0.01
    assert found.by_thickness.sum() * H**3 == pytest.approx(by_thickness, rel=0.05)
    assert found.by_grey.sum() == pytest.approx(found.share.sum() * 0.05 / GREY, rel=1e-5)


def test_a_coat_of_no_thickness_has_no_image():
    assert np.abs(image_of(Coat(0.0, 0.0, GREY, 0.05)).share).max() < 1e-6


def test_a_stated_coat_without_sd_has_a_third():
    coat = stated_coat((36.0, None), (0.15, 0.02))
    assert (coat.thickness_mm, coat.thickness_sd_mm) == pytest.approx((0.036, 0.012))
    assert coat.grey_sd == 0.02
    assert stated_coat(None, (0.15, 0.05)) is None


def test_an_uncleaned_stapes_is_named_and_a_stated_coat_is_corrected(tmp_path):
    bare = score(row_named("mucosa of 35 um"), 20, tmp_path, frames=False, voxel_um=34.0)
    assert "bare_bone_assumed" in bare.codes
    assert bare.error > 0.03
    assert not bare.silent
    stated = score(row_named("mucosa, stated"), 20, tmp_path, frames=False, voxel_um=34.0)
    assert "bare_bone_assumed" not in stated.codes
    assert abs(stated.error) < 2.0 * stated.sd < 0.04


@pytest.mark.parametrize(
    "options",
    [
        {"labels": "labels.nrrd", "coat_um": 35},
        {"scan": "scan.tif", "coat_grey": 0.2},
        {"scan": "scan.tif", "coat_um": 35, "coat_grey": 1.2},
        {"scan": "stapes.stl", "coat_um": 35},
    ],
)
def test_options_of_a_coat_that_say_nothing_are_refused(options):
    with pytest.raises(CtInertiaError) as error:
        MassOptions(density=1900, **options)
    assert "coat" in error.value.faults[0].thing
