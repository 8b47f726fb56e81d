"""MuJoCo's MJCF: SI units; the body's frame is the footplate frame."""

from __future__ import annotations

import re
from pathlib import Path

from legacy.ct_inertia.exports.body import ExportBody, listed, quaternion
from legacy.ct_inertia.exports.obj import obj_text

UNITS = {"length": "m", "mass": "kg", "inertia": "kg m2", "coordinates": "footplate"}
_TEXT = """<mujoco model="stapes">
  <!-- Made by stapeskit from {source}. SI units: m, kg, kg m2. The frame of the body is the footplate frame
       (x anterior, y lateral, origin at the footplate centre); the inertia is in its principal axes about
       the centre of mass; the mesh lies in scan coordinates (mm) and is scaled and placed here. -->
  <compiler angle="radian" inertiafromgeom="false"/>
  <asset>
    <mesh name="stapes" file="stapes.obj" scale="0.001 0.001 0.001"/>
  </asset>
  <worldbody>
    <body name="stapes">
      <freejoint name="stapes"/>
      <inertial pos="{com}" quat="{turn}" mass="{mass}" diaginertia="{moments}"/>
      <geom name="stapes" type="mesh" mesh="stapes" pos="{place}" quat="{pose}" contype="0" conaffinity="0"/>
      <site name="footplate_centre" pos="0 0 0" size="0.00005"/>
      <site name="centre_of_mass" pos="{com}" size="0.00005"/>
    </body>
  </worldbody>
</mujoco>
"""


def write(body: ExportBody, folder: Path) -> list[str]:
    """Write stapes.xml and the mesh it names, stapes.obj; return their names."""
    moments, axes = body.principal()
    pose = body.footplate_from_scan
    text = _TEXT.format(
        source=comment(body.source),
        com=listed(body.com_m),
        turn=listed(quaternion(axes)),
        mass=f"{body.mass_kg:.17g}",
        moments=listed(moments),
        place=listed(pose.translation_mm * 1e-3),
        pose=listed(quaternion(pose.rotation)),
    )
    (folder / "stapes.xml").write_text(text, encoding="utf-8")
    (folder / "stapes.obj").write_text(obj_text(body.stapes, "stapes"), encoding="utf-8")
    return ["stapes.xml", "stapes.obj"]


def comment(text: str) -> str:
    """Make a text fit for an XML comment."""
    return re.sub("-(?=-|$)", "- ", text)
