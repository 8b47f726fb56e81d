"""A mass that is left out is that of the motion; a matrix of another size is refused."""

from types import SimpleNamespace

import numpy as np
import pytest

from fitting.dof2kd import dof2kd
from stapeskit.faults import StapeskitError
from tests.fit.fit_cases import M, paper_motion


def test_a_result_of_points2dof_brings_its_mass():
    motion, _ = paper_motion(0.02, 1)
    brought = dof2kd(SimpleNamespace(motion=motion, mass=M), mass=None, unknowns="none")
    given = dof2kd(motion, mass=M, unknowns="none")
    assert np.array_equal(brought.stiffness, given.stiffness)


def test_a_matrix_of_another_size_is_refused_with_the_right_ones():
    motion, _ = paper_motion(0.02, 1)
    with pytest.raises(StapeskitError, match="3 x 3 or 6 x 6"):
        dof2kd(motion, mass=np.eye(2))
