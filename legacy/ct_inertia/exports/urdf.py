"""URDF: SI units; the link's frame is the footplate frame."""

from __future__ import annotations

from pathlib import Path

from legacy.ct_inertia.exports.body import ExportBody, listed, roll_pitch_yaw
from legacy.ct_inertia.exports.mjcf import comment
from legacy.ct_inertia.exports.obj import obj_text

UNITS = {"length": "m", "mass": "kg", "inertia": "kg m2", "coordinates": "footplate"}
_TEXT = """<?xml version="1.0"?>
<robot name="stapes">
  <!-- Made by stapeskit from {source}. SI units: m, kg, kg m2. The frame of the link is the footplate frame
       (x anterior, y lateral, origin at the footplate centre); the inertia is in its principal axes about
       the centre of mass; the mesh lies in scan coordinates (mm) and is scaled and placed here. -->
  <link name="stapes">
    <inertial>
      <origin xyz="{com}" rpy="{turn}"/>
      <mass value="{mass}"/>
      <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/>
    </inertial>
{shapes}  </link>
</robot>
"""
_SHAPE = """    <{kind}>
      <origin xyz="{place}" rpy="{pose}"/>
      <geometry>
        <mesh filename="stapes.obj" scale="0.001 0.001 0.001"/>
      </geometry>
    </{kind}>
"""


def write(body: ExportBody, folder: Path) -> list[str]:
    """Write stapes.urdf and the mesh it names, stapes.obj; return their names."""
    moments, axes = body.principal()
    pose = body.footplate_from_scan
    place, turn = listed(pose.translation_mm * 1e-3), listed(roll_pitch_yaw(pose.rotation))
    ixx, iyy, izz = (f"{value:.17g}" for value in moments)
    text = _TEXT.format(
        source=comment(body.source),
        com=listed(body.com_m),
        turn=listed(roll_pitch_yaw(axes)),
        mass=f"{body.mass_kg:.17g}",
        ixx=ixx,
        iyy=iyy,
        izz=izz,
        shapes="".join(_SHAPE.format(kind=kind, place=place, pose=turn) for kind in ("visual", "collision")),
    )
    (folder / "stapes.urdf").write_text(text, encoding="utf-8")
    (folder / "stapes.obj").write_text(obj_text(body.stapes, "stapes"), encoding="utf-8")
    return ["stapes.urdf", "stapes.obj"]
