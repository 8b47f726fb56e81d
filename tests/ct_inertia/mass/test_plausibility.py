"""What cannot be a stapes is refused when nobody named it, and told when somebody did."""

from dataclasses import replace

import numpy as np
import pytest

from legacy.ct_inertia.ct2mass import _bodies, ct2mass
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.footplate import footplate_frame
from legacy.ct_inertia.labelling.from_scan import find_bodies
from legacy.ct_inertia.mass.plausibility import body_volumes, check_mesh, implausible
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.surface.surface import Surface, write_surface
from legacy.ct_inertia.volume.coarse_view import coarse_scan, material_levels
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.progress import silent
from tests.ct_inertia.shapes import box, stapes

GREY = (1394.0, 14.0)


def scene_volume(**ear):
    from sample_volumes.phantom import Ear, render, scene

    h = ear["voxel_mm"][0]
    return Volume(render(scene(Ear(**ear))), np.full(3, h), np.zeros(3), np.eye(3))


def written(volume, path):
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(volume.array)
    image.SetSpacing(volume.spacing_mm.tolist())
    sitk.WriteImage(image, str(path))
    return path


@pytest.fixture(scope="module")
def narrow(tmp_path_factory):
    """An ear whose footplate is parted from the bone of its window by less than a voxel."""
    volume = scene_volume(voxel_mm=(0.05,) * 3, gap_mm=0.04, bridges=2)
    return written(volume, tmp_path_factory.mktemp("narrow") / "ear.nrrd")


@pytest.fixture(scope="module")
def emptied(tmp_path_factory):
    """An ear without a stapes: its voxels, and two around them, are air."""
    from scipy.ndimage import binary_dilation

    volume = scene_volume(voxel_mm=(0.05,) * 3)
    found = find_bodies(volume).labels
    stapes = np.zeros(volume.array.shape, dtype=bool)
    first = found.first_index[::-1]
    stapes[tuple(slice(a, a + n) for a, n in zip(first, found.labels.shape, strict=True))] = found.mask(1)
    array = volume.array.copy()
    array[binary_dilation(stapes, iterations=3)] = np.median(array)
    return written(replace(volume, array=array), tmp_path_factory.mktemp("emptied") / "ear.nrrd")


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    """An ear whose scan ends within the stapes."""
    volume = scene_volume(voxel_mm=(0.05,) * 3, shift_mm=(3.0, 0.0, 0.0))
    return written(volume, tmp_path_factory.mktemp("cut") / "ear.nrrd")


def test_real_sizes_pass_and_others_are_named():
    surface = stapes(0.06)
    assert implausible(footplate_frame(surface), surface.volume_mm3) == []
    big = Surface(surface.vertices_mm * 1.6, surface.faces)
    told = implausible(footplate_frame(big), big.volume_mm3)
    assert [text.split(" of ")[0] for text in told] == ["a height", "a footplate length", "a volume"]


def test_the_bone_around_the_window_is_no_stapes(emptied):
    with pytest.raises(
        CtInertiaError, match=r"no object that can be a stapes: .*a height of 1\.3.*--seed.*--labels"
    ):
        ct2mass(MassOptions(emptied, density=GREY))


def test_a_body_that_was_named_is_measured_with_a_warning(narrow):
    result = ct2mass(MassOptions(narrow, density=GREY, seed_mm=(3.0, 3.0, 3.0)))
    assert "size_implausible" in {notice.code for notice in result.notices}


@pytest.fixture(scope="module")
def bodies_of_cut(cut):
    """The bodies of the cut ear, found once: no hint enters the search."""
    return _bodies(MassOptions(cut, density=GREY), silent)


@pytest.mark.parametrize("anterior", [None, (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)])
def test_the_border_is_named_before_any_hint(cut, bodies_of_cut, anterior, monkeypatch):
    monkeypatch.setattr("legacy.ct_inertia.ct2mass._bodies", lambda *_: bodies_of_cut)
    with pytest.raises(
        CtInertiaError, match=r"no object that can be a stapes: .*touches the border of the scan"
    ):
        ct2mass(MassOptions(cut, density=GREY, anterior=anterior))


def test_the_blur_in_a_narrow_gap_is_no_material():
    volume = scene_volume(voxel_mm=(0.05,) * 3, gap_mm=0.06, bridges=2)
    levels = material_levels(coarse_scan(volume))
    assert len(levels) == 3
    assert levels[1] == pytest.approx(14700.0, abs=300.0)


@pytest.mark.parametrize(
    "ear",
    [
        {"voxel_mm": (0.04,) * 3, "gap_mm": 0.04, "analytic": True},
        {"voxel_mm": (0.05,) * 3, "psf_voxels": 1.53, "noise": 0.055, "plate_distance_mm": 0.3},
    ],
)
def test_the_plastic_is_told_from_what_blur_and_noise_make_of_edges(ear, tmp_path):
    from sample_volumes.analytic import write_analytic_stapes

    ear = dict(ear)
    if ear.pop("analytic", False):
        ear["stapes"] = write_analytic_stapes(tmp_path / "stapes.ply")
    levels = material_levels(coarse_scan(scene_volume(pose_seed=11, noise_seed=11, **ear)))
    assert levels == pytest.approx([8000.0, 15000.0, 30000.0], rel=0.03)


def test_a_plate_like_mesh_is_told(tmp_path):
    write_surface(tmp_path / "box.ply", box((3.0, 0.4, 1.4), (7.0, 1.0, 2.0)))
    result = ct2mass(MassOptions(tmp_path / "box.ply", density=GREY))
    text = next(notice.text for notice in result.notices if notice.code == "size_implausible")
    assert "a height of 0.4 mm" in text


def joined(*surfaces):
    starts = np.cumsum([0, *(len(s.vertices_mm) for s in surfaces)])
    return Surface(
        np.vstack([s.vertices_mm for s in surfaces]),
        np.vstack([s.faces + k for s, k in zip(surfaces, starts[:-1], strict=True)]),
    )


def test_two_bodies_in_a_mesh_are_refused_and_a_cavity_is_not(tmp_path):
    body = stapes(0.06)
    write_surface(tmp_path / "two.stl", joined(body, box((5.0, 0.8, 4.0), (0.0, -3.0, 0.0))))
    with pytest.raises(
        CtInertiaError, match=r"one closed body, the stapes; got 2 bodies \(of 16, 1\.54 mm3\)"
    ):
        ct2mass(MassOptions(tmp_path / "two.stl", density=GREY))
    big, small = box((2.0, 2.0, 2.0), (0.0, 0.0, 0.0)), box((1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    hollow = Surface(
        np.vstack([big.vertices_mm, small.vertices_mm]),
        np.vstack([big.faces, small.faces[:, ::-1] + len(big.vertices_mm)]),
    )
    assert sorted(body_volumes(hollow)) == pytest.approx([-1.0, 8.0])
    check_mesh(hollow, "hollow.ply")


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (1e-3, r"it is probably in metres .*multiply it by 1000\)"),
        (0.1, "it is probably in centimetres"),
        (1e3, "it is probably in micrometres"),
        (60.0, "its unit may be that of the voxels"),
    ],
)
def test_a_mesh_in_another_unit_is_refused(tmp_path, factor, told):
    surface = stapes(0.06)
    write_surface(tmp_path / "m.ply", Surface(surface.vertices_mm * factor, surface.faces))
    with pytest.raises(CtInertiaError, match=f"the mesh must be in mm: .*{told}"):
        ct2mass(MassOptions(tmp_path / "m.ply", density=GREY))


def test_a_ball_has_no_footplate(tmp_path):
    import trimesh

    ball = trimesh.creation.icosphere(4, radius=1.7)
    write_surface(tmp_path / "ball.ply", Surface(ball.vertices, ball.faces))
    with pytest.raises(CtInertiaError, match="no object that can be a stapes: no footplate face found"):
        ct2mass(MassOptions(tmp_path / "ball.ply", density=GREY))


def test_a_head_landmark_off_the_bone_is_refused(tmp_path):
    write_surface(tmp_path / "s.ply", stapes(0.06))
    marks = tmp_path / "m.csv"
    marks.write_text("name,x_mm,y_mm,z_mm\nhead,0,-3,0\n")
    with pytest.raises(CtInertiaError, match=r"landmark head must be within 1 mm .*got 3\.00 mm"):
        ct2mass(MassOptions(tmp_path / "s.ply", density=GREY, landmarks=marks))


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("--seed", {"seed_mm": (1.0, 1.0, 1.0)}),
        ("--threshold", {"threshold": 5.0}),
        ("--box", {"box_mm": (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)}),
    ],
)
def test_what_labels_would_leave_unused_is_refused(name, given):
    for scan in (None, "scan.nrrd"):
        with pytest.raises(CtInertiaError) as refused:
            MassOptions(scan, density=GREY, labels="labels.nrrd", **given)
        assert [str(fault).split()[0] for fault in refused.value.faults] == [name]


def test_missing_labels_are_named(tmp_path):
    with pytest.raises(CtInertiaError, match=r"--labels must be an existing label volume; got .*none\.nrrd"):
        ct2mass(MassOptions(None, density=GREY, labels=tmp_path / "none.nrrd"))
