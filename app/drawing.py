"""Labels that a brush changes: strokes, undo, and the file they are kept in.

The picture counts voxels along right, anterior and superior; the labels keep the axes of their file. One is a
view of the other (numpy), so that nothing is resampled and an untouched label stays as it is, bit by bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stapeskit.arrays import Array

RAS = np.array([-1.0, -1.0, 1.0])
"""Factors between scan coordinates (LPS) and those of the picture (RAS)."""

MOST_VOXELS = 12_000_000
"""Voxels of the picture: so many a browser without a graphics card still turns."""

PENS = {"stapes": 1, "other bone": 3, "plate": 2, "erase": 0}
_MARGIN_MM = 1.0  # of bone around the stapes that is shown: as far as a cut is ever moved by hand

Labels = NDArray[np.uint8]
Index = NDArray[np.int64]
Stroke = list[tuple[Labels, Labels]]  # places (views of labels), and what was there before


def ras_view(array: NDArray[np.generic], scan_from_index: Array) -> NDArray[np.generic]:
    """Return a view [s, a, r] of an array [z, y, x]: superior, anterior and right, each ascending."""
    from nibabel.orientations import apply_orientation

    turned: NDArray[np.generic] = apply_orientation(array.T, _orientation(scan_from_index))
    return turned.T


def ras_affine(scan_from_index: Array, shape: Sequence[int], step: int = 1) -> Array:
    """Return the affine (4, 4) from an index r, a, s of `ras_view` to right, anterior, superior, mm.

    Of a grid of a shape z, y, x, every ``step`` voxels of which are one of the picture.
    """
    from nibabel.orientations import inv_ornt_aff

    index_from_view = inv_ornt_aff(_orientation(scan_from_index), tuple(shape[::-1]))
    view_from_picture = np.diag([step, step, step, 1.0])
    view_from_picture[:3, 3] = 0.5 * (step - 1)
    return np.asarray(np.diag([*RAS, 1.0]) @ scan_from_index @ index_from_view @ view_from_picture)


def _orientation(scan_from_index: Array) -> Array:
    """Return, as nibabel does, which axis of the picture each axis of a grid is nearest to, and its sense."""
    from nibabel.orientations import io_orientation

    return np.asarray(io_orientation(np.diag([*RAS, 1.0]) @ scan_from_index))


@dataclass
class Drawing:
    """Labels of a part of the scan, [z, y, x] in the axes of their file, and what was drawn on them."""

    labels: Labels  # 0 background, 1 stapes, 2 plate, 3 other bone
    scan_from_index: Array  # (4, 4)
    found: Labels  # as they were found
    _strokes: list[Stroke] = field(default_factory=list)
    _stroke: Stroke = field(default_factory=list)
    _last: Array | None = None

    def __post_init__(self) -> None:
        self.labels = np.ascontiguousarray(self.labels)
        spacing = np.linalg.norm(self.scan_from_index[:3, :3], axis=0)
        self.box, self.step = shown_part(self.labels, spacing)
        part = ras_view(self.labels[self.box], self.scan_from_index)
        n, k = np.array(part.shape) // self.step, self.step
        split = part.reshape(n[0], k, n[1], k, n[2], k)
        # [s, a, r, step, step, step], a view: the brush changes every voxel beneath one of the picture
        self._blocks: Labels = split.transpose(0, 2, 4, 1, 3, 5)  # type: ignore[assignment]

    @property
    def _picture(self) -> Labels:
        middle = self.step // 2
        return self._blocks[..., middle, middle, middle]

    @property
    def shape(self) -> tuple[int, ...]:
        """Voxels of the box along z, y, x in steps."""
        return tuple((part.stop - part.start) // self.step for part in self.box)

    @property
    def shown(self) -> Labels:
        """The labels [s, a, r] of the picture."""
        return np.ascontiguousarray(self._picture)

    @property
    def affine(self) -> Array:
        """Affine (4, 4) from an index r, a, s of the picture to RAS mm."""
        own = self.scan_from_index.copy()
        own[:3, 3] += own[:3, :3] @ [part.start for part in self.box[::-1]]
        return ras_affine(own, [part.stop - part.start for part in self.box], self.step)

    @property
    def as_found(self) -> bool:
        """Whether every label is as it was found."""
        return np.array_equal(self.labels, self.found)

    def paint(
        self, voxel: Sequence[float], pen: int, radius: int, normal: int | None = None
    ) -> Change | None:
        """Draw from the last place of this stroke to a voxel r, a, s of the picture; return what changed.

        The pen is a label; the brush is a ball of a radius in voxels of the picture, or with ``normal``, the
        axis across a slice, a disc in that slice.
        """
        at = np.rint(voxel)[::-1]
        last = at if self._last is None else self._last
        self._last = at
        reach = np.full(3, float(radius))
        if normal is not None:
            reach[2 - normal] = 0.0
        low = np.maximum(np.minimum(at, last) - reach, 0).astype(int)
        high = np.minimum(np.maximum(at, last) + reach + 1, self._picture.shape).astype(int)
        if np.any(high <= low):
            return None
        box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
        blocks = self._blocks[box]
        drawn = _near_segment(low, high, last, at, max(radius, 0.5))
        drawn &= (blocks != pen).any(axis=(3, 4, 5))
        if not drawn.any():
            return None
        self._stroke.append((blocks, blocks.copy()))
        blocks[drawn] = pen
        index = np.ravel_multi_index(tuple((np.argwhere(drawn) + low).T), self._picture.shape)
        return Change(index.astype(np.uint32), np.full(len(index), pen, dtype=np.uint8))

    def end_stroke(self) -> bool:
        """End a stroke and return whether it changed something."""
        stroke, self._stroke, self._last = self._stroke, [], None
        if stroke:
            self._strokes.append(stroke)
        return bool(stroke)

    def undo(self) -> Change | None:
        """Take the last stroke back."""
        self.end_stroke()
        if not self._strokes:
            return None
        shown = self.shown
        for place, before in reversed(self._strokes.pop()):
            place[...] = before
        return self._since(shown)

    def reset(self) -> Change:
        """Return to the labels as found: a stroke, which can be undone."""
        self.end_stroke()
        shown = self.shown
        self._strokes.append([(self.labels, self.labels.copy())])
        self.labels[...] = self.found
        return self._since(shown)

    def _since(self, before: Labels) -> Change:
        """Return what has changed of the picture since it was as ``before``."""
        now = self.shown.ravel()
        index = np.flatnonzero(now != before.ravel())
        return Change(index.astype(np.uint32), now[index])

    def write(self, path: Path) -> None:
        """Write the labels whole, in the axes and on the voxels that they came in."""
        from ct_inertia.exports.labels import write_segmentation

        write_segmentation(path, [self.labels], self.labels.shape, self.scan_from_index)


@dataclass(frozen=True)
class Change:
    """Voxels of the picture that changed: flat index [s, a, r] and new label."""

    index: NDArray[np.uint32]
    values: Labels


def shown_part(labels: Labels, spacing_mm: Array) -> tuple[tuple[slice, slice, slice], int]:
    """Return the part of labels around the stapes that a browser can show, and its step.

    The step is 1 unless the stapes alone has more voxels than `MOST_VOXELS`.
    """
    shape = np.array(labels.shape)
    used = [np.flatnonzero((labels == 1).any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    first = np.array([one[0] if one.size else 0 for one in used])
    last = np.array([one[-1] if one.size else n - 1 for one, n in zip(used, shape, strict=True)])
    for margin in (_MARGIN_MM, 0.5 * _MARGIN_MM, 0.0):
        away = 4 + (margin / spacing_mm[::-1]).astype(int)
        low = np.maximum(first - away, 0)
        size = np.minimum(last + 1 + away, shape) - low
        if np.prod(size) <= MOST_VOXELS:
            break
    step = max(1, int(np.ceil((np.prod(size) / MOST_VOXELS) ** (1.0 / 3.0))))
    size = np.maximum(size // step, 1) * step
    parts = [slice(int(a), int(a + n)) for a, n in zip(low, size, strict=True)]
    return (parts[0], parts[1], parts[2]), step


def _near_segment(low: Index, high: Index, start: Array, stop: Array, radius: float) -> NDArray[np.bool_]:
    """Return which voxels from ``low`` to ``high`` [s, a, r] are within a radius of a line."""
    places = np.moveaxis(np.indices(tuple(high - low)), 0, -1) + low - start
    along = stop - start
    share = np.clip(places @ along / max(float(along @ along), 1.0), 0.0, 1.0)
    return ((places - share[..., None] * along) ** 2).sum(axis=-1) <= radius**2
