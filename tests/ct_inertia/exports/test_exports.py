"""Every export read back by the program it is made for: mass, centre, inertia, units, frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from legacy.ct_inertia.ct2mass import ct2mass
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.export_formats import EXPORTS
from legacy.ct_inertia.exports import FORMATS, export, parse_formats, units_of
from legacy.ct_inertia.exports.body import body_of, quaternion, roll_pitch_yaw
from legacy.ct_inertia.exports.export import _module
from legacy.ct_inertia.options import MassOptions
from legacy.ct_inertia.surface.surface import read_surface, write_surface
from legacy.stapeskit.frames import RigidTransform
from tests.ct_inertia.shapes import box, moved, stapes

TURN = Rotation.from_euler("xyz", [40, -65, 110], degrees=True).as_matrix()
SHIFT = np.array([7.0, -3.0, 11.0])


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """A stapes lying oblique in the scan, with a bead glued to it: no product of inertia is zero."""
    path = tmp_path_factory.mktemp("mesh") / "bone--1.ply"
    write_surface(path, moved(stapes(0.08), TURN, SHIFT))
    bead = (*(TURN @ [0.4, 2.5, 0.5] + SHIFT), 0.3)
    anterior = tuple((TURN @ [1.0, 0.0, 0.0]).tolist())
    return ct2mass(MassOptions(path, density=(1900.0, 60.0), anterior=anterior, add_mass=(bead,)))


@pytest.fixture(scope="module")
def body(result):
    made = body_of(result)
    plate = moved(box((5.0, 0.8, 4.0), (0.0, -0.9, 0.0)), TURN, SHIFT)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = TURN, TURN @ [0.0, -0.5, 0.0] + SHIFT
    return replace(made, plate=plate, scan_from_plate=RigidTransform(pose, "scan", "plate"))


def tensor(moments, rotation):
    return rotation @ np.diag(moments) @ rotation.T


class TestContract:
    @pytest.mark.parametrize("name", FORMATS)
    def test_every_format_names_its_files_and_units(self, body, tmp_path, name):
        module = _module(name)
        names = module.write(body, tmp_path)
        assert names
        assert set(names) <= set(EXPORTS[name].files)
        assert sorted(names) == sorted(path.name for path in tmp_path.iterdir())
        assert all((tmp_path / file).stat().st_size > 200 for file in names)
        assert module.UNITS["coordinates"] in ("scan", "footplate")
        assert module.UNITS["length"].split()[0] in ("m", "mm")
        assert units_of([name]) == {name: module.UNITS}

    def test_all_of_them_from_a_result(self, result, tmp_path):
        names = export(result, tmp_path / "new")
        assert len(names) == len(set(names))
        assert sorted(names) == sorted(path.name for path in (tmp_path / "new").iterdir())
        assert {"stapes.stl", "stapes.glb", "stapes.xml", "stapes.urdf", "stapes.inp", "mass.mat"} <= set(
            names
        )

    def test_formats_are_read_from_text(self):
        assert parse_formats("all") == FORMATS
        assert parse_formats("mat, STL") == ("stl", "mat")
        for text, got in (("stl,step", "step"), ("", "nothing"), (",", "nothing")):
            with pytest.raises(CtInertiaError, match=f"--export must be a list out of .*; got {got}"):
                parse_formats(text)


class TestMeshes:
    @pytest.mark.parametrize("suffix", ["stl", "obj"])
    def test_lie_in_the_scan_in_mm(self, body, tmp_path, suffix):
        _module(suffix).write(body, tmp_path)
        for name, surface in (("stapes", body.stapes), ("plate", body.plate)):
            read = read_surface(tmp_path / f"{name}.{suffix}")
            assert read.volume_mm3 == pytest.approx(surface.volume_mm3, rel=1e-5)
            assert np.allclose(read.moments().centroid_mm, surface.moments().centroid_mm, atol=1e-5)
            assert len(read.faces) == pytest.approx(len(surface.faces), rel=0.005)

    def test_stl_normals_point_outward(self, body, tmp_path):
        _module("stl").write(body, tmp_path)
        raw = (tmp_path / "plate.stl").read_bytes()
        rows = np.frombuffer(raw[84:], [("n", "<f4", 3), ("c", "<f4", (3, 3)), ("rest", "<u2")])
        middle = body.plate.moments().centroid_mm
        away = rows["c"].mean(axis=1) - middle
        assert np.all(np.einsum("ij,ij->i", rows["n"], away) > 0.0)
        assert b"mm" in raw[:80]

    def test_glb_stands_on_its_footplate_in_metres(self, body, tmp_path):
        import trimesh

        _module("glb").write(body, tmp_path)
        scene = trimesh.load_scene(tmp_path / "stapes.glb", process=False)
        assert set(scene.geometry) == {"stapes", "plate"}
        mesh = scene.geometry["stapes"]
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(body.volume_m3, rel=1e-4)
        inside = body.footplate_from_scan.points(body.stapes.moments().centroid_mm) * 1e-3
        assert np.allclose(mesh.center_mass, inside, atol=1e-8)
        assert scene.geometry["stapes"].bounds[1, 1] == pytest.approx(3.4e-3, abs=2e-4)
        assert scene.geometry["plate"].bounds[1, 1] < 0.0


@pytest.fixture(scope="module")
def model(body, tmp_path_factory):
    import mujoco

    folder = tmp_path_factory.mktemp("mjcf")
    _module("mjcf").write(body, folder)
    return mujoco.MjModel.from_xml_path(str(folder / "stapes.xml"))


class TestMujoco:
    def test_its_own_mass_matrix_is_ours(self, model, body):
        """MuJoCo's joint-space inertia of the free body at rest is M about the footplate centre."""
        import mujoco

        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        columns = []
        for unit in np.eye(6):
            product = np.zeros((6, 1))
            mujoco.mj_mulM(model, data, product, unit[:, None])
            columns.append(product[:, 0])
        root = np.sqrt(np.diag(body.matrix.matrix))
        scaled = (np.column_stack(columns) - body.matrix.matrix) / np.outer(root, root)
        assert np.max(np.abs(scaled)) < 1e-9

    def test_the_mesh_lies_in_the_footplate_frame(self, model, body):
        import mujoco

        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        points = model.mesh_vert @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
        expected = body.footplate_from_scan.points(body.stapes.vertices_mm) * 1e-3
        assert np.allclose(points.min(axis=0), expected.min(axis=0), atol=1e-8)
        assert np.allclose(points.max(axis=0), expected.max(axis=0), atol=1e-8)
        assert model.geom_contype[0] == 0

    def test_mass_comes_from_the_inertial_alone(self, model, body):
        assert model.body_mass[1] == pytest.approx(body.mass_kg, rel=1e-12)
        assert np.allclose(model.body_ipos[1], body.com_m, rtol=1e-12)


@pytest.fixture(scope="module")
def folder(body, tmp_path_factory):
    folder = tmp_path_factory.mktemp("urdf")
    _module("urdf").write(body, folder)
    return folder


class TestUrdf:
    def test_the_parser_of_ros_reads_the_inertia(self, folder, body):
        from urdf_parser_py.urdf import URDF

        robot = URDF.from_xml_string((folder / "stapes.urdf").read_bytes())
        inertial = robot.link_map["stapes"].inertial
        turn = Rotation.from_euler("xyz", inertial.origin.rpy).as_matrix()
        found = turn @ np.array(inertial.inertia.to_matrix()) @ turn.T
        assert inertial.mass == pytest.approx(body.mass_kg, rel=1e-12)
        assert np.allclose(inertial.origin.xyz, body.com_m, rtol=1e-12)
        assert np.allclose(found, body.inertia_kg_m2, atol=1e-9 * found.max())

    def test_the_mesh_is_scaled_and_placed(self, folder, body):
        from urdf_parser_py.urdf import URDF

        link = URDF.from_xml_string((folder / "stapes.urdf").read_bytes()).link_map["stapes"]
        expected = body.footplate_from_scan.points(body.stapes.moments().centroid_mm) * 1e-3
        for shape in (link.visual, link.collision):
            mesh = read_surface(folder / shape.geometry.filename)
            scaled = mesh.moments().centroid_mm * np.array(shape.geometry.scale)
            turn = Rotation.from_euler("xyz", shape.origin.rpy).as_matrix()
            assert np.allclose(turn @ scaled + shape.origin.xyz, expected, atol=1e-9)

    def test_mujoco_reads_it_too(self, folder, body):
        import mujoco

        text = (folder / "stapes.urdf").read_text(encoding="utf-8")
        floating = (
            '<link name="world"/><joint name="free" type="floating"><parent link="world"/>'
            '<child link="stapes"/></joint></robot>'
        )
        mesh = {"stapes.obj": (folder / "stapes.obj").read_bytes()}
        model = mujoco.MjModel.from_xml_string(text.replace("</robot>", floating), mesh)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_iquat[1])
        found = tensor(model.body_inertia[1], turn.reshape(3, 3))
        assert model.body_mass[1] == pytest.approx(body.mass_kg, rel=1e-12)
        assert np.allclose(found, body.inertia_kg_m2, atol=1e-9 * found.max())


@pytest.fixture(scope="module")
def blocks(body, tmp_path_factory):
    """Keyword lines with the numbers under each."""
    folder = tmp_path_factory.mktemp("inp")
    _module("abaqus").write(body, folder)
    found: dict[str, list[list[float]]] = {}
    for line in (folder / "stapes.inp").read_text(encoding="utf-8").splitlines():
        if line.startswith("**") or not line:
            continue
        if line.startswith("*"):
            last = line
            found[last] = []
        else:
            assert all(len(field.strip()) <= 20 for field in line.split(","))
            found[last].append([float(field) for field in line.split(",")])
    return found


class TestAbaqus:
    def test_equations_and_masses_give_the_mass_matrix(self, blocks, body):
        """M = sum of A' m A over the point masses, A from the equations; tonne, mm, s to SI."""
        nodes = [int(row[0]) for row in blocks["*NODE, NSET=STAPES_POINTS"]]
        assert [row[1] for row in blocks["*ELEMENT, TYPE=MASS, ELSET=STAPES_MASS"]] == nodes
        rows = {}
        for count, line in zip(blocks["*EQUATION"][::2], blocks["*EQUATION"][1::2], strict=True):
            terms = np.array(line).reshape(int(count[0]), 3)
            assert terms[0, 2] == 1.0  # the first degree of freedom is the dependent one
            row = rows.setdefault((terms[0, 0], terms[0, 1]), np.zeros(6))
            for node, axis, factor in terms[1:]:
                row[{900001: 0, 900002: 3}[int(node)] + int(axis) - 1] -= factor
        assert set(rows) == {(node, axis) for node in nodes for axis in (1, 2, 3)}
        (mass,) = blocks["*MASS, ELSET=STAPES_MASS"][0]
        found = sum(mass * np.outer(row, row) for row in rows.values())
        unit = np.array([1e-3] * 3 + [1.0] * 3)  # mm and rad to m and rad: force is N, moment N mm
        found = found * 1e3 * np.outer(1.0 / unit, 1.0 / unit) * 1e-6
        root = np.sqrt(np.diag(body.matrix.matrix))
        assert np.max(np.abs(found - body.matrix.matrix) / np.outer(root, root)) < 1e-9

    def test_points_lie_around_the_centre_of_mass(self, blocks, body):
        places = np.array(blocks["*NODE, NSET=STAPES_POINTS"])[:, 1:]
        assert np.allclose(places.mean(axis=0) * 1e-3, body.com_m, rtol=1e-9)
        assert blocks["*NODE, NSET=STAPES_FOOTPLATE"] == [[900001.0, 0.0, 0.0, 0.0]]


class TestMatlab:
    def test_holds_matrix_frames_names_and_units(self, body, tmp_path):
        from scipy.io import loadmat

        made = replace(body, plate_matrix=body.matrix)
        _module("mat").write(made, tmp_path)
        read = loadmat(tmp_path / "mass.mat", simplify_cells=True)
        assert np.array_equal(read["M"], body.matrix.matrix)
        assert np.array_equal(read["M_sd"], body.matrix.standard_deviation)
        assert list(read["dof"]) == ["x", "y", "z", "alpha", "beta", "gamma"]
        assert list(read["parameter_names"])[:2] == ["m", "mx"]
        c = read["c"]
        cross = np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])
        about = read["J"] - read["mass_kg"] * cross @ cross
        assert np.allclose(about, read["M"][3:, 3:], rtol=1e-10)
        assert np.array_equal(read["frames"]["scan_from_footplate"], body.scan_from_footplate.matrix)
        between = np.linalg.inv(read["frames"]["scan_from_plate"]) @ read["frames"]["scan_from_footplate"]
        assert np.allclose(read["frames"]["plate_from_footplate"], between)
        assert "kg m2" in read["units"]["M"]


class TestRotations:
    def test_quaternion_and_angles_agree_with_scipy(self):
        poles = [np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])]
        poles += [Rotation.from_euler("y", angle, degrees=True).as_matrix() for angle in (90, -90)]
        for turn in [np.eye(3), *poles, *Rotation.random(40, random_state=1).as_matrix()]:
            w, *xyz = quaternion(turn)
            assert np.allclose(Rotation.from_quat([*xyz, w]).as_matrix(), turn, atol=1e-12)
            again = Rotation.from_euler("xyz", roll_pitch_yaw(turn)).as_matrix()
            assert np.allclose(again, turn, atol=1e-9)

    def test_principal_axes_are_a_rotation_near_the_footplate_axes(self, body):
        moments, axes = body.principal()
        assert np.linalg.det(axes) == pytest.approx(1.0)
        assert np.allclose(tensor(moments, axes), body.inertia_kg_m2, rtol=1e-9, atol=1e-22)
        assert np.all(np.diag(axes) > 0.5)


@pytest.mark.parametrize("name", ["a--b", "---", "x---><actuator>", "-", "a->b"])
def test_a_name_does_not_end_a_comment(name):
    text = _module("mjcf").comment(name)
    assert "--" not in text
    assert not text.endswith("-")
