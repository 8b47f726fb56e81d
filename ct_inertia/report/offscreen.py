"""Off-screen rendering in a separate process, so that a crash of the GL driver does not end the command.

Run as ``python -m ct_inertia.report.offscreen FOLDER`` by draw_offscreen: reads ``job.npz`` and writes
``done.npy``.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ct_inertia.report.drawn_body import Body

Array = NDArray[np.float64]
Panel = tuple[Sequence["Body"], Array, Array, float]
TIMEOUT_S = 60.0
SWITCH = "STAPESKIT_OFFSCREEN"


def draw_offscreen(panels: Sequence[Panel], pixels: int) -> tuple[list[Array] | None, str]:
    """Render panels in a child process.

    The environment variable ``STAPESKIT_OFFSCREEN=0`` switches it off.

    Parameters
    ----------
    panels : sequence of (bodies, picture_from_scan (4, 4), centre_mm (2,), half_mm)
    pixels : int
        Width and height of each raster.

    Returns
    -------
    rasters : list of ndarray, (pixels, pixels, 3), uint8, or None
        None when it does not work on this machine.
    reason : str
        Why, in a few words; empty on success.
    """
    if os.environ.get(SWITCH) == "0":
        return None, f"{SWITCH}=0"
    with tempfile.TemporaryDirectory(prefix="stapeskit-") as name:
        folder = Path(name)
        _write_job(folder / "job.npz", panels, pixels)
        environment = os.environ | {"VTK_DEFAULT_OPENGL_WINDOW": "vtkEGLRenderWindow"}
        root = str(Path(__file__).resolve().parents[2])
        environment["PYTHONPATH"] = os.pathsep.join([root, *filter(None, [environment.get("PYTHONPATH")])])
        try:
            child = subprocess.run(
                [sys.executable, "-P", "-m", "ct_inertia.report.offscreen", str(folder)],
                env=environment,
                capture_output=True,
                timeout=TIMEOUT_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as fault:
            return None, type(fault).__name__
        done = folder / "done.npy"
        if child.returncode != 0 or not done.is_file():
            return None, _reason(child)
        rasters = np.load(done)
    if len(rasters) != len(panels) or all(float(raster.std()) == 0.0 for raster in rasters):
        return None, "the pictures came out empty"
    return list(rasters), ""


def _reason(child: subprocess.CompletedProcess[bytes]) -> str:
    """Say in a few words how the child ended."""
    if child.returncode < 0:
        return f"the renderer ended by signal {-child.returncode}"
    lines = child.stderr.decode(errors="replace").strip().splitlines()
    return lines[-1][:160] if lines else f"exit code {child.returncode}"


def _write_job(path: Path, panels: Sequence[Panel], pixels: int) -> None:
    """Write every body once, and for each panel which bodies it shows from where."""
    from matplotlib.colors import to_rgb

    known: dict[int, int] = {}
    arrays: dict[str, Any] = {"pixels": np.array(pixels), "count": np.array(len(panels))}
    for place, (bodies, matrix, centre, half) in enumerate(panels):
        for body in bodies:
            if id(body) not in known:
                number = known[id(body)] = len(known)
                arrays[f"vertices{number}"] = np.asarray(body.vertices_mm, dtype=np.float32)
                arrays[f"faces{number}"] = np.asarray(body.faces, dtype=np.int64)
                arrays[f"look{number}"] = np.array([*to_rgb(body.color), body.opacity, body.smooth])
        arrays[f"shown{place}"] = np.array([known[id(body)] for body in bodies])
        arrays[f"matrix{place}"] = matrix
        arrays[f"frame{place}"] = np.array([*centre, half])
    np.savez(path, **arrays)


def _render(folder: Path) -> None:
    """Render what ``job.npz`` describes; every raster in one window."""
    import pyvista

    job = np.load(folder / "job.npz")
    pixels = int(job["pixels"])
    meshes: dict[int, Any] = {}
    rasters = []
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=[pixels, pixels], lighting="none")
    plotter.set_background("white")
    for place in range(int(job["count"])):
        plotter.clear_actors()
        matrix, (right, up, half) = job[f"matrix{place}"], job[f"frame{place}"]
        for number in job[f"shown{place}"]:
            if number not in meshes:
                meshes[number] = _mesh(job, number)
            *colour, opacity, smooth = job[f"look{number}"]
            plotter.add_mesh(
                meshes[number],
                color=colour,
                opacity=opacity,
                smooth_shading=bool(smooth),
                culling="back" if opacity < 1.0 else None,
                specular=0.1,
                ambient=0.2,
                diffuse=0.8,
            )
        _look(plotter, matrix, right, up, half)
        rasters.append(_picture(plotter.render_window))
    np.save(folder / "done.npy", np.stack(rasters))


def _picture(window: Any) -> Any:
    """Render once, and return what the window then holds, (rows, columns, 3), uint8, the top row first."""
    import pyvista
    from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

    window.Render()
    reader = vtkWindowToImageFilter()
    reader.SetInput(window)
    reader.SetInputBufferTypeToRGB()
    reader.ReadFrontBufferOff()
    reader.ShouldRerenderOff()
    reader.Update()
    image = pyvista.wrap(reader.GetOutput())
    columns, rows, _ = image.dimensions
    return np.array(image.active_scalars).reshape(rows, columns, 3)[::-1]


def _mesh(job: Any, number: int) -> Any:
    """Return one surface, with normals at its vertices when its edges shall look smooth."""
    import pyvista

    mesh = pyvista.PolyData.from_regular_faces(job[f"vertices{number}"], job[f"faces{number}"])
    if not job[f"look{number}"][-1]:
        return mesh
    return mesh.compute_normals(cell_normals=False, consistent_normals=False, split_vertices=False)


def _look(plotter: Any, matrix: Array, right: float, up: float, half: float) -> None:
    """Set a parallel projection whose picture spans ``half`` mm around a centre, and one light at the eye."""
    import pyvista

    turn, shift = matrix[:3, :3], matrix[:3, 3]
    distance = 20.0 * half
    focus = turn.T @ (np.array([right, up, 0.0]) - shift)
    eye = turn.T @ (np.array([right, up, distance]) - shift)
    plotter.camera_position = [eye, focus, turn[1]]
    plotter.camera.parallel_projection = True
    plotter.camera.parallel_scale = half
    plotter.camera.clipping_range = (0.01 * distance, 3.0 * distance)
    plotter.remove_all_lights()
    lamp = focus + turn.T @ np.array([-0.6, 0.8, 1.4]) * distance
    plotter.add_light(pyvista.Light(position=lamp, focal_point=focus, intensity=0.7))
    plotter.add_light(pyvista.Light(position=eye, focal_point=focus, intensity=0.35))


if __name__ == "__main__":
    _render(Path(sys.argv[1]))
