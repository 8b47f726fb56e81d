"""A surface with fewer triangles or less noise, for pictures and exports; no result is computed from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.surface.surface import Surface
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.spatial import matrix_from_parameters

# Steps of Taubin's smoothing, the defaults of MeshLab: pass band 1 / lambda + 1 / mu = 0.11.
_LAMBDA, _MU = 0.5, -0.53
# Least faces that are accepted. Chosen by judgement: far fewer than keep the shape of a stapes.
_LEAST_FACES = 100


@dataclass(frozen=True)
class Step:
    """What one step did to the surface.

    Attributes
    ----------
    name : str
        ``smooth`` or ``faces``.
    asked : int
        Steps of smoothing, or number of faces.
    faces : int
        Triangles afterwards.
    mass_change : float
        Relative change of the enclosed volume, and so of a mass at fixed density.
    center_of_mass_change_mm : ndarray, (3,)
        Scan axes.
    matrix_change : float
        Largest change of an entry of the mass matrix about the centre of mass, of sqrt(Mii Mjj).
    """

    name: str
    asked: int
    faces: int
    mass_change: float
    center_of_mass_change_mm: Array
    matrix_change: float

    def as_json(self) -> dict[str, Any]:
        """Return the step for the JSON, in percent."""
        return {
            "step": self.name,
            "asked": self.asked,
            "faces": self.faces,
            "mass_change_percent": 100.0 * self.mass_change,
            "center_of_mass_change_mm": self.center_of_mass_change_mm.tolist(),
            "mass_matrix_change_percent": 100.0 * self.matrix_change,
        }

    @property
    def words(self) -> str:
        """The step in a sentence."""
        what = f"{self.asked} steps of Taubin smoothing" if self.name == "smooth" else f"{self.faces} faces"
        shift = float(np.linalg.norm(self.center_of_mass_change_mm)) * 1e3
        return (
            f"{what}: mass {100.0 * self.mass_change:+.3f} %, centre of mass {shift:.2f} um, "
            f"M within {100.0 * self.matrix_change:.3f} %"
        )


@dataclass(frozen=True)
class DisplayMesh:
    """A surface for display and export, and what it would have done to the mass."""

    surface: Surface
    steps: tuple[Step, ...]

    def as_json(self) -> dict[str, Any]:
        """Return its entry of mass.json."""
        return {
            "file": "stapes_display.ply",
            "used_for": "pictures and exports; no number of this file comes from it",
            "faces": len(self.surface.faces),
            "steps": [step.as_json() for step in self.steps],
        }


def display_mesh(surface: Surface, smooth: int | None = None, faces: int | None = None) -> DisplayMesh:
    """Smooth and thin out a surface.

    Parameters
    ----------
    surface : Surface
        Closed, outward, mm.
    smooth : int, optional
        Steps of Taubin smoothing (lambda 0.5, mu -0.53), first.
    faces : int, optional
        Triangles to be left by quadric edge collapse, topology kept; not fewer than 100.

    Raises
    ------
    CtInertiaError
        pymeshlab is missing, or the surface does not stay closed and outward.

    Notes
    -----
    Taubin 1995, SIGGRAPH, doi:10.1145/218380.218473; Garland and Heckbert 1997, doi:10.1145/258734.258849.
    """
    steps = []
    thinned = surface
    if smooth:
        thinned = _filter(
            thinned, "{smooth}", "apply_coord_taubin_smoothing", lambda_=_LAMBDA, mu=_MU, stepsmoothnum=smooth
        )
        steps.append(_step("smooth", smooth, surface, thinned))
    if faces is not None and faces < len(thinned.faces):
        before = thinned
        thinned = _filter(
            thinned,
            "{faces}",
            "meshing_decimation_quadric_edge_collapse",
            targetfacenum=faces,
            preservetopology=True,
            preservenormal=True,
            optimalplacement=True,
            autoclean=False,
        )
        steps.append(_step("faces", faces, before, thinned))
    return DisplayMesh(thinned, tuple(steps))


def check_request(smooth: int | None, faces: int | None) -> None:
    """Refuse numbers that no display surface can have, before anything is computed.

    Raises
    ------
    CtInertiaError
        Too few or too many of them, or pymeshlab is missing.
    """
    if smooth is not None and not 0 <= smooth <= 500:
        raise CtInertiaError.of(
            "{smooth}", "from 0 to 500 steps", smooth, next_step="10 to 30 steps calm a surface"
        )
    if faces is not None and faces < _LEAST_FACES:
        raise CtInertiaError.of(
            "{faces}", f"at least {_LEAST_FACES}", faces, next_step="20000 keep every feature"
        )
    if smooth or faces is not None:
        _pymeshlab("{smooth}" if smooth else "{faces}")


def _pymeshlab(option: str) -> Any:
    try:
        import pymeshlab
    except (ImportError, OSError) as fault:
        raise CtInertiaError.of(
            option,
            "used where pymeshlab works",
            f"{type(fault).__name__}: {fault}",
            next_step="Run pip install pymeshlab (on Debian also apt-get install libgl1 libopengl0)",
        ) from fault
    return pymeshlab


def _filter(surface: Surface, option: str, name: str, **values: Any) -> Surface:
    """Apply one filter about the middle of the surface, where single precision loses nothing."""
    pymeshlab = _pymeshlab(option)
    middle = 0.5 * (surface.vertices_mm.min(axis=0) + surface.vertices_mm.max(axis=0))
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(surface.vertices_mm - middle, surface.faces.astype(np.int32)))
    getattr(meshes, name)(**values)
    meshes.meshing_remove_unreferenced_vertices()
    mesh = meshes.current_mesh()
    try:
        return Surface(mesh.vertex_matrix() + middle, mesh.face_matrix().astype(np.int64))
    except CtInertiaError as fault:
        raise CtInertiaError.of(
            option, "weak enough to leave the surface closed", f"{fault}", next_step="Ask for less of it"
        ) from fault


def _step(name: str, asked: int, before: Surface, after: Surface) -> Step:
    """Compare the mass properties of two surfaces at the same density."""
    old, new = before.moments(), after.moments()
    shift = new.centroid_mm - old.centroid_mm
    matrices = []
    for moments, place in ((old, np.zeros(3)), (new, shift)):
        v = moments.volume_mm3
        tensor = moments.inertia_mm5 + v * (place @ place * np.eye(3) - np.outer(place, place))
        packed = [tensor[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))]
        matrices.append(matrix_from_parameters([v, *(v * place), *packed]))
    root = np.sqrt(np.diag(matrices[0]))
    change = np.abs(matrices[1] - matrices[0]) / np.outer(root, root)
    return Step(
        name, asked, len(after.faces), new.volume_mm3 / old.volume_mm3 - 1.0, shift, float(change.max())
    )
