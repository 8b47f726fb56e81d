"""NIfTI headers that give two different places or sizes of their voxels."""

import numpy as np
import pytest
import SimpleITK as sitk

from legacy.ct_inertia.read_scan import read_volume
from tests.ct_inertia.readers import writers as f
from tests.ct_inertia.readers.test_place import TURN
from tests.ct_inertia.readers.writers import SPACING, picture


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda head: head, False),
        (lambda head: head.__setitem__(slice(280, 284), np.float32(-1.03 * SPACING[0]).tobytes()), True),
        (lambda head: head.__setitem__(slice(292, 296), np.float32(4.0).tobytes()), True),
        (lambda head: head.__setitem__(slice(292, 296), np.float32(0.001).tobytes()), False),
        (lambda head: head.__setitem__(slice(252, 254), np.int16(0).tobytes()), False),
    ],
    ids=["alike", "sizes", "places", "rounding", "no qform"],
)
def test_a_nifti_header_that_contradicts_itself_is_told(tmp_path, change, told):
    image = sitk.GetImageFromArray(picture(np.int16))
    image.SetSpacing(SPACING.tolist())
    sitk.WriteImage(image, str(tmp_path / "a.nii"))  # sform and qform
    content = bytearray((tmp_path / "a.nii").read_bytes())
    change(content)
    (tmp_path / "a.nii").write_bytes(bytes(content))
    codes = [notice.code for notice in read_volume(tmp_path / "a.nii").notices]
    assert ("two_places_told" in codes) is told


def test_voxel_sizes_beside_an_sform_are_compared_without_a_qform(tmp_path):
    matrix = np.column_stack([np.diag([-1, -1, 1]) @ TURN * SPACING * 1.02, [1.0, 2.0, 3.0]])
    volume = read_volume(f.nifti(tmp_path / "a.nii", picture(np.int16, (60, 50, 40)), sform=matrix))
    assert "two_places_told" in [notice.code for notice in volume.notices]
