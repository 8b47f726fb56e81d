"""A shell that a mesh holds twice would double the mass: it is refused, whatever its sense and order."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.mass.plausibility import check_mesh, repeated_faces
from legacy.ct_inertia.surface.surface import Surface, read_surface


@pytest.mark.parametrize("seed", range(3))
def test_the_same_shell_twice_is_refused(seed, tmp_path):
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.7)
    ball.apply_scale(rng.uniform(0.8, 1.2, 3))
    again = ball.faces[rng.permutation(len(ball.faces))]
    again = np.array([np.roll(face, rng.integers(3)) for face in again]) + len(ball.vertices)
    both = trimesh.Trimesh(np.vstack([ball.vertices] * 2), np.vstack([ball.faces, again]), process=False)
    file = tmp_path / "twice.stl"
    both.export(file)
    surface = read_surface(file)
    assert repeated_faces(surface) == len(ball.faces)
    with pytest.raises(CtInertiaError) as refused:
        check_mesh(surface, file.name)
    assert refused.value.faults[0].thing == "the mesh"
    once = Surface(np.asarray(ball.vertices), np.asarray(ball.faces))
    assert repeated_faces(once) == 0
    check_mesh(once, "once.stl")
