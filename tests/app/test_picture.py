"""Surfaces as the browser gets them: closed, outward, where they belong."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

pytest.importorskip("ipyniivue")

from app.picture import balls, write_stl


def test_points_are_small_closed_bodies_at_their_places(tmp_path):
    places = [[1.0, -2.0, 3.0], [4.0, 5.0, -6.0]]
    shown = trimesh.load(write_stl(tmp_path / "points.stl", balls(places)))
    bodies = shown.split()
    assert len(bodies) == len(places)
    for body in bodies:
        assert body.is_watertight
        assert 0.0 < body.volume < 0.2**3  # positive: its faces look outwards
    centres = sorted(body.center_mass.round(4).tolist() for body in bodies)
    assert np.allclose(centres, sorted(places), atol=1e-4)
