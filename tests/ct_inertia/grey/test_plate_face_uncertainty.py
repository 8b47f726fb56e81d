"""What an uncertain face of the plate leaves open in the share of bone: the face moved by that much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from legacy.ct_inertia.bodies import PlateFace
from legacy.ct_inertia.grey.plate_face import FaceFit, plate_share
from legacy.ct_inertia.grey.plate_face_uncertainty import face_doubt
from legacy.ct_inertia.segment.extract_stapes import Cut
from legacy.ct_inertia.volume.volume import Volume

H, CONTRAST = 0.04, 20000.0


@pytest.fixture
def scene():
    shape = (12, 14, 16)
    volume = Volume(np.zeros(shape, dtype=np.uint16), np.full(3, H), np.zeros(3), np.eye(3))
    nothing = np.zeros(shape, dtype=bool)
    cut = Cut(np.zeros(3, dtype=np.int64), np.zeros(shape, dtype=np.float32), nothing, nothing, nothing, "")
    normal = np.array([0.1, 0.2, 1.0]) / np.linalg.norm([0.1, 0.2, 1.0])
    face = PlateFace(normal, 0.2, 0.05, 2000.0, 9000.0, 0.01)
    basis = np.linalg.svd(normal[None, :])[2][1:].T
    return volume, cut, face, basis


def test_it_is_what_a_face_higher_by_its_sd_would_take_off(scene):
    volume, cut, face, basis = scene
    where = np.ones(volume.array.shape, dtype=bool)
    sd = 0.01
    fit = FaceFit(face, face.offset_mm * face.normal, basis, np.diag([sd**2, 0.0, 0.0, 1e-6, 1.0, 1.0]))
    doubt = face_doubt(fit, volume, cut, where, CONTRAST)
    up, down = (replace(face, offset_mm=face.offset_mm + sign * sd) for sign in (0.5, -0.5))
    step = (plate_share(up, volume, cut, where) - plate_share(down, volume, cut, where)) / CONTRAST
    assert np.abs(np.abs(doubt[where]) - step).max() < 0.01 * step.max()
    assert np.all(doubt >= 0.0) or np.all(doubt <= 0.0)


def test_a_face_that_is_well_known_leaves_nothing_open(scene):
    volume, cut, face, basis = scene
    where = np.ones(volume.array.shape, dtype=bool)
    fit = FaceFit(face, face.offset_mm * face.normal, basis, np.diag([3e-4**2, 1e-8, 1e-8, 1e-6, 1.0, 1.0]))
    assert face_doubt(fit, volume, cut, where, CONTRAST) is None
