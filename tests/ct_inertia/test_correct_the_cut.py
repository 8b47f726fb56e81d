"""docs/correct_the_cut.md as it is printed: measure, change a segment with SimpleITK, measure again."""

import re
import shlex
import struct
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile

from legacy.ct_inertia.cli import work
from legacy.ct_inertia.read_scan import read_volume
from tests.ct_inertia.ears import ear

pytestmark = pytest.mark.usefixtures("undrawn")

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "correct_the_cut.md").read_text(encoding="utf-8")
COMMANDS = [block.strip() for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)]
SCRIPT = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)[1]


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A folder with a TIFF, and what the first command of the page writes there."""
    folder = tmp_path_factory.mktemp("lab")
    made = ear(h=0.05, seed=2)
    x, y, z = made.volume.spacing_mm
    tifffile.imwrite(
        folder / "scan.tif",
        np.asarray(made.volume.array),
        imagej=True,
        resolution=(1 / x, 1 / y),
        metadata={"spacing": z, "unit": "mm", "axes": "ZYX"},
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        first = run(COMMANDS[0])
    return folder, first


def run(line):
    words = shlex.split(line)
    assert words[0] == "ct2mass"
    return work([*words[1:], "--no-report"])[1]


def test_labels_and_crop_lie_on_the_scan_in_other_programs(lab):
    folder = lab[0] / "scan_mass"
    scan = read_volume(lab[0] / "scan.tif")
    crop = sitk.ReadImage(str(folder / "scan_crop.nrrd"))
    grey = sitk.GetArrayFromImage(crop)
    for name in ("labels.nrrd", "labels.seg.nrrd", "scan_crop.nrrd"):
        image = sitk.ReadImage(str(folder / name))
        corner = image.TransformIndexToPhysicalPoint((0, 0, 0))
        index = scan.index_points(np.array(corner))
        assert np.max(np.abs(index - np.rint(index))) < 1e-6
        assert image.GetSpacing() == pytest.approx(scan.spacing_mm)
    start = np.rint(scan.index_points(np.array(crop.GetOrigin()))).astype(int)
    z, y, x = (slice(a, a + n) for a, n in zip(start[::-1], grey.shape, strict=True))
    assert np.array_equal(grey, scan.array[z, y, x])
    labels = sitk.ReadImage(str(folder / "labels.seg.nrrd"))
    on_crop = sitk.GetArrayFromImage(sitk.Resample(labels, crop, sitk.Transform(), sitk.sitkNearestNeighbor))
    assert (on_crop == 1).sum() == (sitk.GetArrayFromImage(labels) == 1).sum()
    assert grey[on_crop == 1].mean() > grey[on_crop == 0].mean()


def test_the_geometry_of_nifti_programs_is_the_same(lab, tmp_path):
    """nibabel takes the rows of the sform as RAS; it is scan coordinates with x and y negative."""
    for name in ("labels.nrrd", "scan_crop.nrrd"):
        image = sitk.ReadImage(str(lab[0] / "scan_mass" / name))
        sitk.WriteImage(image, str(tmp_path / "a.nii"))
        head = (tmp_path / "a.nii").read_bytes()[:348]
        assert struct.unpack_from("<h", head, 254)[0] > 0
        rows = np.array(struct.unpack_from("<12f", head, 280)).reshape(3, 4)
        read = read_volume(lab[0] / "scan_mass" / name)
        assert np.allclose(np.diag([-1.0, -1.0, 1.0]) @ rows, read.scan_from_index[:3], atol=1e-6)


def test_the_page_is_followed_as_it_is_printed(lab, monkeypatch):
    folder, first = lab
    monkeypatch.chdir(folder)
    exec(compile(SCRIPT, "correct_the_cut.md", "exec"), {})
    mine = (folder / "scan_mass" / "labels.seg.nrrd").read_bytes()
    second = run(COMMANDS[1])
    assert (folder / "scan_mass" / "labels.seg.nrrd").read_bytes() == mine
    assert second.result["labels_file"] == "labels.measured.nrrd"
    names = {path.name for path in second.files}
    assert {"labels.measured.nrrd", "labels.measured.seg.nrrd", "scan_crop.nrrd", "mass.json"} <= names
    lost = first.result["volume_m3"] - second.result["volume_m3"]
    assert 0.0 < lost < 0.1 * first.result["volume_m3"]
    com = "center_of_mass_in_scan_mm"
    assert second.result[com][1] < first.result[com][1]
    again = run(COMMANDS[1])
    assert again.result["volume_m3"] == pytest.approx(second.result["volume_m3"], rel=1e-12)
    with pytest.raises(Exception, match="edited since"):
        run(COMMANDS[0])
