"""A body whose own bone is twice as bright as what was taken for bone holds something soft."""

from types import SimpleNamespace

import numpy as np
import pytest

from legacy.ct_inertia.segment.local_threshold import takes_soft_for_bone


@pytest.mark.parametrize(
    ("taken_for_bone", "soft"), [(1000.0, False), (800.0, False), (450.0, True), (350.0, True)]
)
def test_fluid_is_not_taken_for_bone(taken_for_bone, soft):
    grey = np.full((20, 20, 20), 0.0, dtype=np.float32)
    pieces = np.zeros(grey.shape, dtype=np.int32)
    pieces[4:16, 4:16, 4:16] = 1
    grey[4:16, 4:16, 4:16] = 1000.0
    grey[4:8, 4:16, 4:16] = 350.0
    sight = SimpleNamespace(
        scan=SimpleNamespace(grey=grey),
        pieces=pieces,
        stapes=SimpleNamespace(label=1),
        air=0.0,
        bone=taken_for_bone,
    )
    assert takes_soft_for_bone(sight) is soft
