"""Grey values are those that the program shows which wrote the file; a damaged file gives none."""

import numpy as np
import pytest

from ct_inertia.scan.open_scan import open_scan
from stapeskit.faults import StapeskitError
from tests.scan_files import scan_writers as w
from tests.scan_files.scan_writers import picture


def test_a_packed_nifti_is_read_to_its_check_sum(tmp_path):
    path = w.itk(tmp_path / "a.nii.gz", picture(shape=(50, 50, 50)))
    content = bytearray(path.read_bytes())
    content[-6] ^= 1  # of the check sum
    path.write_bytes(content)
    with pytest.raises(StapeskitError) as caught:
        open_scan(path).read()
    assert "a damaged or truncated one" in caught.value.faults[0].got


def test_imagej_values_are_those_that_it_shows(tmp_path):
    """Signed 16-bit pictures are stored 32768 higher, with the line back in the description."""
    line = {"cf": 0, "c0": -32768.0, "c1": 1.0}
    path = w.imagej(tmp_path / "a.tif", picture(), metadata=line)
    assert np.array_equal(open_scan(path).read(), picture().astype(float) - 32768.0)
    w.imagej(path, picture(), metadata={"cf": 3})
    (text,) = [notice.text for notice in open_scan(path).notices if notice.code == "file_read"]
    assert "by its function 3" in text
