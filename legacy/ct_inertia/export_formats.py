"""The table of exports: each is a module of ct_inertia.exports and one line here.

A module has ``UNITS`` and ``write(body, folder)``, which returns the names of its files: some of those in the
table, which are checked for other people's files before anything is computed.
"""

from __future__ import annotations

from typing import NamedTuple


class ExportFormat(NamedTuple):
    """An entry: the module that writes, the files that it writes, and a summary for the help."""

    module: str
    files: tuple[str, ...]
    summary: str


EXPORTS = {
    "stl": ExportFormat("stl", ("stapes.stl", "plate.stl"), "mm, scan axes"),
    "obj": ExportFormat("obj", ("stapes.obj", "plate.obj"), "mm, scan axes"),
    "glb": ExportFormat("glb", ("stapes.glb",), "m, footplate axes"),
    "mjcf": ExportFormat("mjcf", ("stapes.xml", "stapes.obj"), "MuJoCo"),
    "urdf": ExportFormat("urdf", ("stapes.urdf", "stapes.obj"), "robot description"),
    "abaqus": ExportFormat("abaqus", ("stapes.inp",), "finite elements, also CalculiX"),
    "mat": ExportFormat("matlab", ("mass.mat",), "MATLAB"),
}
FORMATS: tuple[str, ...] = tuple(EXPORTS)
FILES = tuple(dict.fromkeys(name for entry in EXPORTS.values() for name in entry.files))
"""Every file that an export may write."""
