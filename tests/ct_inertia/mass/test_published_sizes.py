"""Sizes next to published ones: z-scores, references, a notice where every publication disagrees."""

import pytest

from legacy.ct_inertia.mass.published_sizes import CODE, NAMES, PUBLISHED, comparisons, unusual_notice

USUAL = {
    "volume_mm3": 1.4,
    "mass_mg": 2.7,
    "density_kg_m3": 1900.0,
    "height_mm": 3.3,
    "footplate_length_mm": 2.8,
    "footplate_width_mm": 1.35,
}


def test_a_usual_stapes_gives_no_notice_and_every_comparison():
    assert unusual_notice(USUAL) == []
    rows = comparisons(USUAL)
    assert len(rows) == len(PUBLISHED)
    volume = rows[0]
    assert volume["z"] == pytest.approx((1.4 - 1.24) / 0.29)
    assert "doi:10.1038/s41598-024-69608-9" in volume["reference"]


def test_a_large_stapes_is_named_with_its_z_score():
    notice = unusual_notice({**USUAL, "volume_mm3": 2.31})
    assert [one.code for one in notice] == [CODE]
    assert "z +3.7" in notice[0].text
    assert "volume" in notice[0].text
    assert "height" not in notice[0].text


def test_one_publication_that_agrees_is_enough():
    # 3.9 sd from one publication, inside the range of the other.
    assert unusual_notice({**USUAL, "height_mm": 2.8}) == []
    assert unusual_notice({**USUAL, "height_mm": 4.4})[0].code == CODE


def test_every_publication_has_a_name_and_a_reference():
    for one in PUBLISHED:
        assert one.quantity in NAMES
        assert len(one.reference) > 20
        assert one.sd is None or one.sd > 0.0
