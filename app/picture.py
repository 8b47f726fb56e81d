"""Three slices, 3D and a brush: everything that touches ipyniivue.

ipyniivue's own drawing does not reach Python with today's marimo (the array that it should send back never
comes). So the brush paints in Python: the browser says which voxel the mouse is at (``location_change``), and
is sent the voxels that changed (``buffer_update``). Two private names of ipyniivue 2.4 are used for that,
`_handle_custom_msg` and the message ``buffer_update``; the pins in pyproject.toml hold what was driven.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from ipyniivue import Mesh, MultiplanarType, NiiVue, ShowRender, SliceType
from ipyniivue.traits import ColorMap
from numpy.typing import NDArray

from app.drawing import RAS, Change, Drawing
from app.grey import write_nifti
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError

Corners = NDArray[np.floating[Any]]
Place = Sequence[float]
Colour = tuple[int, int, int, int]
View = Literal["slices and 3D", "slices", "3D"]
VIEWS: tuple[View, ...] = ("slices", "slices and 3D", "3D")
"""The first is how the page begins: 3D beside slices takes seconds a move without a graphics card."""

_OPACITY = 0.45  # of labels over grey values: both can be read
_BALL_MM = 0.09  # radius of a point in 3D
_COLOURS: dict[str, Colour] = {
    "stapes": (230, 184, 0, 255),
    "plate": (58, 160, 255, 255),
    "marks": (255, 0, 255, 255),
}
_VERDICTS = {"ok": (60, 200, 80, 255), "unused": (150, 150, 150, 255)}
_SUSPECT = (255, 70, 50, 255)


class Picture(NiiVue):  # type: ignore[misc]
    """The picture of one page; Python holds the labels, the browser draws what it is sent."""

    def __init__(self) -> None:
        super().__init__(
            height=700,
            multiplanar_show_render=ShowRender.NEVER,
            is_radiological_convention=True,
            multiplanar_layout=MultiplanarType.GRID,
            mesh_thickness_on_2d=0.02,
            is_orientation_text_visible=False,
            drag_and_drop_enabled=False,
            show_3d_crosshair=True,
            back_color=(0.07, 0.07, 0.07, 1.0),
            crosshair_width=0.6,
            loading_text="no scan yet",
        )
        self.set_draw_colormap(
            ColorMap(
                R=[0, 230, 58, 255],
                G=[0, 184, 160, 106],
                B=[0, 0, 255, 77],
                A=[0, 255, 255, 255],
                labels=["", "stapes", "plate", "other bone"],
            )
        )
        self.draw_opacity = _OPACITY
        self.pen: int | None = None  # label of the brush; without one a click only moves the crosshair
        self.radius, self.ball = 3, True  # a ball, or a disc in the slice
        self.point: Array | None = None  # the crosshair in scan coordinates, mm
        self.on_point: Callable[[Array], Any] = lambda _: None  # called when the mouse is released
        self.on_stroke: Callable[[], Any] = lambda: None
        self._drawing: Drawing | None = None
        self._files = tempfile.TemporaryDirectory(prefix="stapeskit_app_")
        self._number = 0

    def clicked(self) -> Array:
        """Return the crosshair in scan coordinates, mm; a `StapeskitError` before the first click."""
        if self.point is None:
            raise StapeskitError("Click a place in a slice first.")
        return self.point

    def show(self, grey: NDArray[np.uint8], affine: Array, drawing: Drawing | None = None) -> None:
        """Show grey values [s, a, r] and, on the same voxels, the labels of a drawing."""
        self.clear()
        self._drawing = drawing
        self.load_volumes([{"path": write_nifti(self._next("grey.nii"), grey, affine)}])

    def clear(self) -> None:
        """Show no scan, and forget the place that was clicked in the last one."""
        self._drawing, self.point = None, None
        if self.volumes:
            self.close_drawing()
            self.load_volumes([])

    def show_change(self, change: Change | None) -> None:
        """Draw voxels that have changed."""
        if change is not None:
            data = {"attr": "drawBitmap", "type": "uint8", "indices_type": "uint32"}
            buffers = [change.index.tobytes(), change.values.tobytes()]
            self.send({"type": "buffer_update", "data": data}, buffers=buffers)

    def show_all(self) -> None:
        """Draw every label anew."""
        if self._drawing is not None:
            path = self._next("labels.nii")
            self.load_drawing(str(write_nifti(path, self._drawing.shown, self._drawing.affine)))

    def show_meshes(
        self,
        surfaces: Mapping[str, Corners],
        points: Sequence[tuple[str, str, Place]],
        marks: Sequence[Place],
    ) -> None:
        """Show the corners of ``stapes`` and ``plate``, points (body, verdict, place) and marks; scan mm.

        marimo closes what a cell has made when that cell runs again: all of them are made in one.
        """
        shown: list[tuple[Colour, Corners]] = [
            (_COLOURS[name], corners) for name, corners in surfaces.items()
        ]
        places: dict[Colour, list[Place]] = {_COLOURS["marks"]: list(marks)}
        for _, verdict, place in points:
            if np.all(np.isfinite(place)):
                places.setdefault(_VERDICTS.get(verdict, _SUSPECT), []).append(place)
        shown += [(colour, balls(own)) for colour, own in places.items() if own]
        self.meshes = [
            Mesh(path=write_stl(self._next("surface.stl"), corners * RAS), rgba255=list(colour))
            for colour, corners in shown
        ]

    def set_view(self, view: View) -> None:
        """Show slices, 3D or both; 3D alone shows surfaces and points without grey values."""
        self.opts.multiplanar_show_render = ShowRender.NEVER if view == "slices" else ShowRender.ALWAYS
        self.set_slice_type(SliceType.RENDER if view == "3D" else SliceType.MULTIPLANAR)
        self.draw_opacity = 0.0 if view == "3D" else _OPACITY
        for volume in self.volumes:
            volume.opacity = 0.0 if view == "3D" else 1.0

    def show_boundary(self, only: bool) -> None:
        """Draw the boundary of the labels only, or all of them."""
        rim = np.array([1.0 if only else -1.0], dtype=np.float32)
        data = {"attr": "drawRimOpacity", "type": "float32"}
        self.send({"type": "buffer_change", "data": data}, buffers=[rim.tobytes()])
        self.draw_opacity = 0.02 if only else _OPACITY

    def _handle_custom_msg(self, content: Mapping[str, Any], _buffers: Any) -> None:
        event, data = content.get("event"), content.get("data") or {}
        if event == "image_loaded":
            self.show_all()
        elif event == "location_change":
            self.point = np.array(data["mm"][:3], dtype=float) * RAS
            if self.pen is not None and self._drawing is not None and data["ax_cor_sag"] < 3:
                normal = None if self.ball else 2 - int(data["ax_cor_sag"])
                self.show_change(self._drawing.paint(data["vox"][:3], self.pen, self.radius, normal))
        elif event == "mouse_up":
            self.on_stroke()
            if self.point is not None:
                self.on_point(self.point)

    def _next(self, name: str) -> Path:
        self._number += 1
        return Path(self._files.name) / f"{self._number}_{name}"


def balls(places: Sequence[Place]) -> Corners:
    """Return the corners (8 n, 3, 3) of a small octahedron at each of n places."""
    signs = np.array(list(product((-1.0, 1.0), repeat=3)))
    one = _BALL_MM * signs[:, :, None] * np.eye(3)
    one[signs.prod(axis=1) < 0.0] = one[signs.prod(axis=1) < 0.0, ::-1]  # counter-clockwise from outside
    return np.asarray(np.array(places)[:, None, None] + one).reshape(-1, 3, 3)


def write_stl(path: Path, corners: Corners) -> Path:
    """Write triangles (n, 3, 3) as binary STL, which NiiVue reads, and return the path."""
    fields = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    rows = np.zeros(len(corners), dtype=fields)
    rows["corners"] = corners
    path.write_bytes(bytes(80) + np.uint32(len(rows)).tobytes() + rows.tobytes())
    return path
