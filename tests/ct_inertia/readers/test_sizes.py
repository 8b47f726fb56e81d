"""Sizes, channels and segments of headers that are no whole numbers are refused."""

import numpy as np
import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_volume
from tests.ct_inertia.readers import writers as f
from tests.ct_inertia.readers.writers import picture


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("a.nrrd", "sizes: 5 6 7", "sizes: 5 6 1e400"),
        ("a.nrrd", "sizes: 5 6 7", "sizes: 5 6 7.5"),
        ("a.nrrd", "sizes: 5 6 7", "sizes: 5 nan 7"),
        ("a.mha", "DimSize = 5 6 7", "DimSize = 5 6 inf"),
        ("a.mha", "DimSize = 5 6 7", "DimSize = 5 6.25 7"),
        ("a.mha", "DimSize = 5 6 7", "ElementNumberOfChannels = x\nDimSize = 5 6 7"),
    ],
)
def test_sizes_that_are_no_whole_numbers_are_refused(tmp_path, name, old, new):
    path = {"a.nrrd": f.nrrd, "a.mha": f.meta}[name](tmp_path / name, picture())
    whole = path.read_bytes()
    assert whole.count(old.encode()) == 1
    path.write_bytes(whole.replace(old.encode(), new.encode()))
    with pytest.raises(
        CtInertiaError, match=r"the scan must be a readable (NRRD|MetaImage) volume; got"
    ) as told:
        read_volume(path, 0.02)
    assert new.split()[-1] in str(told.value) or "= x" in str(told.value)


@pytest.mark.parametrize(("key", "value"), [("LabelValue", "one"), ("LabelValue", "1.5"), ("Layer", "x")])
def test_segments_without_whole_numbers_are_refused(tmp_path, key, value):
    keys = {"Segment0_LabelValue": "1", "Segment0_Layer": "0"} | {f"Segment0_{key}": value}
    path = f.nrrd(tmp_path / "a.nrrd", np.stack([picture(np.uint8)] * 2, axis=-1)[..., 0])
    whole = path.read_bytes()
    text = "".join(f"{name}:={word}\n" for name, word in keys.items()).encode()
    whole = whole.replace(b"sizes: 5 6 7", b"sizes: 2 5 6 7").replace(b"dimension: 3", b"dimension: 4")
    whole = whole.replace(b"spacings: ", b"kinds: list domain domain domain\nspacings: nan ")
    head, _, voxels = whole.partition(b"\n\n")
    path.write_bytes(head + b"\n" + text + b"\n" + np.repeat(np.frombuffer(voxels, "u1"), 2).tobytes())
    with pytest.raises(CtInertiaError, match=f"readable NRRD volume; got segment 0 with value .*{value}"):
        read_volume(path)
