"""Landmark files of other programs, their coordinate systems, and what is wrong with bad ones."""

from __future__ import annotations

import json

import numpy as np
import pytest

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.frames.landmarks import read_landmarks
from legacy.stapeskit.faults import StapeskitError

POINT = [1.25, -2.5, 3.0]
IN_RAS = [-1.25, 2.5, 3.0]


def slicer(system, position, **more):
    control = {"label": "head", "position": position, "positionStatus": "defined", **more}
    return json.dumps(
        {"markups": [{"coordinateSystem": system, "coordinateUnits": "mm", "controlPoints": [control]}]}
    )


FCSV = """# Markups fiducial file version = 4.11
# CoordinateSystem = {system}
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
vtkMRMLMarkupsFiducialNode_0,{x},{y},{z},0,0,0,1,1,1,0,head,,
"""
# As Slicer wrote it up to 4.10; the label of another point holds a comma.
OLD_FCSV = """# Markups fiducial file version = 4.10
# CoordinateSystem = 0
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
vtkMRMLMarkupsFiducialNode_1,9,9,9,0,0,0,1,1,1,0,"nose, left",,vtkMRMLScalarVolumeNode1
vtkMRMLMarkupsFiducialNode_0,-1.25,2.5,3.0,0,0,0,1,1,1,0,head,,vtkMRMLScalarVolumeNode1
"""
PICKED = """<!DOCTYPE PickedPoints>
<PickedPoints><DocumentData/>
 <point name="head" active="1" x="1.25" y="-2.5" z="3.0"/>
 <point name="off" active="0" x="9" y="9" z="9"/>
</PickedPoints>
"""


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("f.mrk.json", slicer("LPS", POINT)),
        ("f.mrk.json", slicer("RAS", IN_RAS)),
        ("f.mrk.json", slicer("ras", IN_RAS)),
        ("f.mrk.json", slicer("LPS", [1250.0, -2500.0, 3000.0]).replace('"mm"', '"um"')),
        ("f.mrk.json", slicer("RAS", [-0.125, 0.25, 0.3]).replace('"mm"', '["cm", "cm", "cm"]')),
        ("f.fcsv", FCSV.format(system="LPS", x=1.25, y=-2.5, z=3.0)),
        ("f.fcsv", FCSV.format(system="RAS", x=-1.25, y=2.5, z=3.0)),
        ("f.fcsv", FCSV.format(system="0", x=-1.25, y=2.5, z=3.0)),
        ("f.fcsv", FCSV.format(system="1", x=1.25, y=-2.5, z=3.0)),
        ("f.fcsv", "\n".join(FCSV.format(system="", x=-1.25, y=2.5, z=3.0).splitlines()[2:])),
        ("f.fcsv", OLD_FCSV),
        ("f.pp", PICKED),
        ("f.csv", "name,x_mm,y_mm,z_mm\nhead,1.25,-2.5,3.0\n"),
        ("f.csv", "name;x_mm;y_mm;z_mm\r\nhead;1,25;-2,5;3,0\r\n"),
    ],
)
def test_every_format_gives_the_same_scan_point(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    assert np.array_equal(read_landmarks(path)["head"], POINT)


@pytest.mark.parametrize("spelled", ["Footplate Center", "footplate-centre", " FOOTPLATE_CENTER "])
def test_names_are_read_in_any_spelling(tmp_path, spelled):
    path = tmp_path / "f.csv"
    path.write_text(f"name,x_mm,y_mm,z_mm\n{spelled},1,2,3\n")
    assert list(read_landmarks(path)) == ["footplate_centre"]


def test_undefined_control_points_are_left_out(tmp_path):
    path = tmp_path / "f.mrk.json"
    content = json.loads(slicer("LPS", POINT))
    content["markups"][0]["controlPoints"].append({"label": "anterior", "positionStatus": "undefined"})
    path.write_text(json.dumps(content))
    assert list(read_landmarks(path)) == ["head"]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("f.txt", "head 1 2 3", r"must be a .mrk.json, .fcsv, .pp or .csv file; got f.txt"),
        ("f.json", "{", "must be a markups file of 3D Slicer"),
        ("f.json", "[]", "must be a markups file of 3D Slicer"),
        ("f.json", '{"markups": [1]}', "must be a markups file of 3D Slicer"),
        ("f.json", '{"markups": [{"controlPoints": null}]}', "must be a markups file of 3D Slicer"),
        (
            "f.mrk.json",
            slicer("LPS", POINT).replace('"mm"', '"pixel"'),
            "coordinateUnits must be one unit of length; got pixel",
        ),
        (
            "f.mrk.json",
            slicer("LPS", POINT).replace('"mm"', '["mm", "um", "mm"]'),
            "coordinateUnits must be one unit of length",
        ),
        ("f.mrk.json", slicer("XYZ", POINT), "the coordinate system must be LPS or RAS; got XYZ"),
        ("f.mrk.json", slicer("LPS", [1, 2]), "a landmark's position must be three numbers"),
        ("f.mrk.json", slicer("LPS", POINT, label="nose"), "the landmarks must be named out of anterior"),
        ("f.fcsv", "a,1,2,3\n", "must be complete up to its label"),
        (
            "f.fcsv",
            FCSV.format(system="LPS", x="one", y=2, z=3),
            "a landmark's position must be three numbers",
        ),
        ("f.pp", "<PickedPoints>", "must be XML of MeshLab"),
        ("f.csv", "name,x,y,z\nhead,1,2,3\n", "the columns must be name, x_mm, y_mm, z_mm; got no x_mm"),
        ("f.csv", "name,x_mm,y_mm,z_mm\nhead,1,2,three\n", r'z_mm must be a number; got "three"'),
        ("f.csv", "name,x_mm,y_mm,z_mm\nhead,1,2,\n", "landmark head must be three finite numbers"),
        ("f.csv", "name,x_mm,y_mm,z_mm\nhead,1,2,3\nHead,1,2,4\n", "landmark Head must be named once"),
    ],
)
def test_a_faulty_file_is_told(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(StapeskitError, match=message):
        read_landmarks(path)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(CtInertiaError, match="the landmark file must be an existing file"):
        read_landmarks(tmp_path / "none.csv")


def test_binary_data_is_told(tmp_path):
    path = tmp_path / "f.pp"
    path.write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(CtInertiaError, match="must be text in UTF-8"):
        read_landmarks(path)
