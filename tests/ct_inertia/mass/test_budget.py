"""The budget of a mass matrix: what known changes of a body make of mass, centre and diagonal."""

import numpy as np
import pytest

from legacy.ct_inertia.mass.budget import budget
from legacy.ct_inertia.mass.mass_estimates import MassByWay, disagreements
from legacy.ct_inertia.mass.mass_properties import MassProperties
from legacy.stapeskit.records.mass_record import MassMatrix
from legacy.stapeskit.spatial import matrix_from_parameters, parameters_from_matrix, twist_transfer

MASS, CENTRE = 3e-6, np.array([0.1e-3, 0.9e-3, -0.2e-3])
ABOUT_CENTRE = np.diag([MASS, MASS, MASS, 2e-12, 1.5e-12, 3e-12])


def parameters(centre=CENTRE, scale=1.0):
    transfer = twist_transfer(np.eye(3), centre)
    return parameters_from_matrix(transfer.T @ (scale * ABOUT_CENTRE) @ transfer)


def matrix(scale=1.0, **changes):
    """The body, each source a change of its parameters of one standard deviation."""
    parts = {name: np.outer(change, change) for name, change in changes.items()}
    return MassMatrix("footplate_centre", "footplate", parameters(scale=scale), parts)


def test_a_heavier_body_keeps_its_centre():
    found = budget(matrix(density=0.02 * parameters()))["density"]
    assert found["mass_kg"] == pytest.approx(0.02 * MASS)
    assert found["center_of_mass_m"] == pytest.approx([0.0] * 3, abs=1e-12)
    assert found["mass_matrix_diagonal_si"] == pytest.approx(
        0.02 * np.diag(matrix_from_parameters(parameters()))
    )


def test_a_body_displaced_keeps_its_mass():
    shift = np.array([0.0, 1e-9, -2e-9])
    found = budget(matrix(frame=parameters(CENTRE + shift) - parameters()))["frame"]
    assert found["mass_kg"] == pytest.approx(0.0, abs=1e-20)
    assert found["center_of_mass_m"] == pytest.approx(np.abs(shift), rel=1e-9, abs=1e-16)


def test_a_bead_at_the_origin_draws_the_centre_towards_it():
    found = budget(matrix(added_mass=np.array([1e-9, *np.zeros(9)])))["added_mass"]
    assert found["center_of_mass_m"] == pytest.approx(np.abs(CENTRE) * 1e-9 / MASS)


def test_sources_add_in_quadrature():
    found = budget(matrix(density=0.03 * parameters(), noise=0.04 * parameters()))
    assert found["total"]["mass_kg"] == pytest.approx(0.05 * MASS)


def by_way(way, scale, share=None):
    body = matrix(scale) if share is None else matrix(scale, **{way: share * scale * parameters()})
    return MassByWay(way, MassProperties(1900.0, MASS / 1900.0, CENTRE * 1e3, body.parameters), body)


def test_changes_against_the_leading_way_are_in_percent():
    found = by_way("density", 1.1).as_json(by_way("mass", 1.0).matrix)
    assert found["mass_change_percent"] == pytest.approx(10.0)
    assert found["matrix_change_percent"][0][0] == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("off", "share", "told"),
    [(0.11, 0.03, False), (0.14, 0.03, True), (-0.14, 0.03, True), (0.04, None, False), (0.06, None, True)],
)
def test_two_ways_disagree_beyond_three_sd_or_five_percent_where_one_has_none(off, share, told):
    ways = [by_way("mass", 1.0, 0.03 if share else None), by_way("density", 1.0 + off, share)]
    found = disagreements(ways)
    assert [notice.code for notice in found] == ["masses_disagree"] * told
    assert all(f"({100.0 * off:+.1f} %)" in notice.text for notice in found)
