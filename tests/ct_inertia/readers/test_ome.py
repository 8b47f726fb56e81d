"""Images of OME-TIFF in several files, several images in one, and names that are no files."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.read_scan import read_volume
from legacy.ct_inertia.readers.companions import data_files
from tests.ct_inertia.readers.writers import SPACING, picture


def test_an_ome_image_in_several_files(tmp_path):
    array = picture()
    names = [f"part{k}.ome.tif" for k in range(7)]
    ids = [f"urn:uuid:00000000-0000-4000-8000-{k:012d}" for k in range(7)]
    data = "".join(
        f'<TiffData FirstZ="{k}" IFD="0" PlaneCount="1">'
        f'<UUID FileName="{names[k]}">{ids[k]}</UUID></TiffData>'
        for k in range(7)
    )
    for k in range(7):
        xml = (
            '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" '
            f'UUID="{ids[k]}"><Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint16" '
            'SizeX="5" SizeY="6" SizeZ="7" SizeC="1" SizeT="1" PhysicalSizeX="20" PhysicalSizeY="25" '
            f'PhysicalSizeZ="30"><Channel ID="Channel:0:0" SamplesPerPixel="1"/>{data}</Pixels></Image></OME>'
        )
        tifffile.imwrite(tmp_path / names[k], array[k], description=xml, metadata=None)
    volume = read_volume(tmp_path / names[0])
    assert np.array_equal(np.asarray(volume.array), array)
    assert volume.spacing_mm == pytest.approx(SPACING)
    assert data_files(tmp_path / names[2]) == [tmp_path / name for name in names if name != names[2]]


OME = (
    '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="{own}">'
    "{images}{more}</OME>"
)
PIXELS = (
    '<Image ID="Image:{n}"><Pixels ID="Pixels:{n}" DimensionOrder="XYZCT" Type="uint16" SizeX="5" SizeY="6" '
    'SizeZ="{z}" SizeC="1" SizeT="1" PhysicalSizeX="{x}" PhysicalSizeY="{x}" PhysicalSizeZ="{x}">'
    '<Channel ID="Channel:{n}:0" SamplesPerPixel="1"/>{data}</Pixels></Image>'
)


def test_an_overview_before_the_stack_does_not_lend_it_its_voxel_size(tmp_path):
    data = '<TiffData FirstZ="0" IFD="{}" PlaneCount="{}"/>'
    images = PIXELS.format(n=0, z=1, x=100, data=data.format(0, 1))
    images += PIXELS.format(n=1, z=7, x=20, data=data.format(1, 7))
    path = tmp_path / "a.ome.tif"
    planes = np.concatenate([picture()[:1], picture()])
    xml = OME.format(own="urn:uuid:1", images=images, more="")
    tifffile.imwrite(path, planes, description=xml, metadata=None, contiguous=False)
    volume = read_volume(path)
    assert np.array_equal(np.asarray(volume.array), picture())
    assert volume.spacing_mm == pytest.approx([0.02] * 3)
    unplaced = xml.replace('<TiffData FirstZ="0" IFD="0" PlaneCount="1"/>', "").replace(
        'SizeZ="1"', 'SizeZ="7"'
    )
    tifffile.imwrite(path, picture(), description=unplaced.replace('IFD="1"', 'IFD="0"'), metadata=None)
    with pytest.raises(CtInertiaError, match="the OME header has several images"):
        read_volume(path)


def test_an_image_that_lies_in_another_file_is_read_from_there(tmp_path):
    ids = ["urn:uuid:00000000-0000-4000-8000-000000000001", "urn:uuid:00000000-0000-4000-8000-000000000002"]
    arrays = [picture(), picture()[::-1] + 1]
    images = "".join(
        PIXELS.format(
            n=n,
            z=7,
            x=(20, 30)[n],
            data=f'<TiffData IFD="0" PlaneCount="7"><UUID FileName="p{n}.ome.tif">{ids[n]}</UUID></TiffData>',
        )
        for n in range(2)
    )
    for n in range(2):
        xml = OME.format(own=ids[n], images=images, more="")
        tifffile.imwrite(tmp_path / f"p{n}.ome.tif", arrays[n], description=xml, metadata=None)
    for n in range(2):
        volume = read_volume(tmp_path / f"p{n}.ome.tif")
        assert np.array_equal(np.asarray(volume.array), arrays[0])
        assert volume.spacing_mm == pytest.approx([0.02] * 3)


def test_names_of_files_in_annotations_are_no_data_files(tmp_path):
    more = (
        '<StructuredAnnotations><XMLAnnotation ID="Annotation:0"><Value><Acquired OriginalFileName="/a/b.czi"'
        "/></Value></XMLAnnotation></StructuredAnnotations>"
    )
    images = PIXELS.format(n=0, z=7, x=20, data='<TiffData IFD="0" PlaneCount="7"/>')
    path = tmp_path / "a.ome.tif"
    tifffile.imwrite(
        path, picture(), description=OME.format(own="urn:uuid:1", images=images, more=more), metadata=None
    )
    assert np.array_equal(np.asarray(read_volume(path).array), picture())
