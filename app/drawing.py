"""Labels that a brush changes: strokes, undo, and the file they are kept in.

The picture counts voxels along right, anterior and superior; the labels keep the axes of their file. One is a
view of the other (numpy), so that nothing is resampled and an untouched label stays as it is, bit by bit.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.study_file import check_unchanged, stamp
from stapeskit.arrays import Array

RAS = np.array([-1.0, -1.0, 1.0])
"""Factors between scan coordinates (LPS) and those of the picture (RAS)."""

MOST_VOXELS = 12_000_000
"""Voxels of the picture: so many a browser without a graphics card still turns."""

PENS = {"stapes": 1, "other bone": 3, "plate": 2, "erase": 0}
_MARGIN_MM = 1.0

Labels = NDArray[np.uint8]
Index = NDArray[np.int64]


def ras_axes(direction: Array) -> tuple[tuple[int, ...], tuple[bool, ...]]:
    """Return, for right, anterior and superior, the nearest axis x, y, z of a grid and whether it runs back.

    Parameters
    ----------
    direction : ndarray, (3, 3)
        Columns: directions of the grid's axes in scan coordinates (LPS).
    """
    turned = RAS[:, None] * np.asarray(direction)
    best = max(itertools.permutations(range(3)), key=lambda p: sum(abs(turned[a, p[a]]) for a in range(3)))
    return best, tuple(bool(turned[a, best[a]] < 0.0) for a in range(3))


def ras_view(array: NDArray[np.generic], direction: Array) -> NDArray[np.generic]:
    """Return a view [s, a, r] of an array [z, y, x]: superior, anterior and right, each ascending."""
    axes, back = ras_axes(direction)
    turned = array.T.transpose(axes)
    return turned[tuple(slice(None, None, -1 if one else 1) for one in back)].T


def ras_affine(scan_from_index: Array, shape: Sequence[int], step: int = 1) -> Array:
    """Return the affine (4, 4) from an index r, a, s of `ras_view` to right, anterior, superior, mm.

    Parameters
    ----------
    scan_from_index : ndarray, (4, 4)
        Of the grid, index x, y, z to scan coordinates, mm.
    shape : sequence of 3 int
        Of the grid, z, y, x.
    step : int
        Voxels of the grid per voxel of the picture.
    """
    direction = scan_from_index[:3, :3] / np.linalg.norm(scan_from_index[:3, :3], axis=0)
    axes, back = ras_axes(direction)
    index_from_view = np.zeros((4, 4))
    index_from_view[3, 3] = 1.0
    for place, (axis, reverse) in enumerate(zip(axes, back, strict=True)):
        index_from_view[axis, place] = -step if reverse else step
        middle = 0.5 * (step - 1)
        index_from_view[axis, 3] = shape[2 - axis] - 1 - middle if reverse else middle
    return np.diag([*RAS, 1.0]) @ scan_from_index @ index_from_view


@dataclass
class Drawing:
    """Labels of a part of the scan, and what was drawn on them.

    Attributes
    ----------
    labels : ndarray of uint8, [z, y, x]
        All of them, in the axes of their file: 0 background, 1 stapes, 2 plate, 3 other bone.
    scan_from_index : ndarray, (4, 4)
    found : ndarray of uint8, [z, y, x]
        As they were found.
    box : tuple of 3 slice
        Along z, y, x: the part that the picture shows.
    step : int
        Voxels per voxel of the picture along each axis; the brush changes all of them.
    """

    labels: Labels
    scan_from_index: Array
    found: Labels
    box: tuple[slice, slice, slice]
    step: int = 1
    strokes: list[list[tuple[Index, Labels]]] = field(default_factory=list)
    _stroke: list[tuple[Index, Labels]] = field(default_factory=list)
    _last: Index | None = None
    _stamp: tuple[int, int] | None = None

    @classmethod
    def of(cls, labels: Labels, scan_from_index: Array, found: Labels | None = None) -> Drawing:
        """Take the labels of a file; those that were found are the same without ``found``."""
        box, step = shown_part(labels, np.linalg.norm(scan_from_index[:3, :3], axis=0))
        start = labels.copy() if found is None else found
        return cls(np.ascontiguousarray(labels), np.asarray(scan_from_index), start, box, step)

    @property
    def blocks(self) -> Labels:
        """View [s, a, r, step, step, step] of the part that is shown."""
        part = ras_view(self.labels[self.box], self._direction)
        n, k = np.array(part.shape) // self.step, self.step
        split = part.reshape(n[0], k, n[1], k, n[2], k)
        return split.transpose(0, 2, 4, 1, 3, 5)  # type: ignore[return-value]

    @property
    def shown(self) -> Labels:
        """The labels [s, a, r] of the picture."""
        middle = self.step // 2
        return np.ascontiguousarray(self.blocks[..., middle, middle, middle])

    @property
    def affine(self) -> Array:
        """Affine (4, 4) from an index r, a, s of the picture to RAS mm."""
        first = np.array([part.start for part in self.box[::-1]])
        own = self.scan_from_index.copy()
        own[:3, 3] += own[:3, :3] @ first
        shape = [part.stop - part.start for part in self.box]
        return ras_affine(own, shape, self.step)

    @property
    def as_found(self) -> bool:
        """Whether every label is as it was found."""
        return np.array_equal(self.labels, self.found)

    @property
    def _direction(self) -> Array:
        own = self.scan_from_index[:3, :3]
        return own / np.linalg.norm(own, axis=0)

    def paint(self, voxel: Sequence[float], pen: int, radius: int, normal: int | None = None) -> Change:
        """Draw from the last place of this stroke to a voxel.

        Parameters
        ----------
        voxel : sequence of 3 float
            Index r, a, s of the picture.
        pen : int
            The label.
        radius : int
            Of the brush, voxels of the picture.
        normal : int, optional
            Axis across the slice, 0, 1 or 2, for a disc in that slice; a ball without it.

        Returns
        -------
        Change
            The voxels of the picture that changed.
        """
        at = np.asarray(voxel, dtype=float)
        last = at if self._last is None else self._last
        steps = max(int(np.ceil(np.abs(at - last).max())), 1)
        places = np.rint(last + np.linspace(0.0, 1.0, steps + 1)[:, None] * (at - last)).astype(np.int64)
        every = np.unique((places[:, None] + _brush(radius, normal)).reshape(-1, 3), axis=0)
        blocks = self.blocks
        r, a, s = every[((every >= 0) & (every < blocks.shape[2::-1])).all(axis=1)].T
        differ = (blocks[s, a, r] != pen).any(axis=(1, 2, 3))
        index = np.stack([s, a, r])[:, differ]
        self._last = at
        if index.size:
            self._stroke.append((index, blocks[tuple(index)].copy()))
            blocks[tuple(index)] = pen
        return self._change(index, blocks)

    def end_stroke(self) -> bool:
        """End a stroke and return whether it changed something."""
        changed, self._last = bool(self._stroke), None
        if changed:
            self.strokes.append(self._stroke)
            self._stroke = []
        return changed

    def undo(self) -> Change:
        """Take the last stroke back."""
        self.end_stroke()
        return self._restore([self.strokes.pop()] if self.strokes else [])

    def _restore(self, strokes: Sequence[list[tuple[Index, Labels]]]) -> Change:
        blocks, touched = self.blocks, [np.zeros((3, 0), dtype=np.int64)]
        for stroke in strokes:
            for index, before in reversed(stroke):
                blocks[tuple(index)] = before
                touched.append(index)
        return self._change(np.unique(np.concatenate(touched, axis=1), axis=1), blocks)

    def reset(self) -> None:
        """Return to the labels as found; this cannot be undone."""
        self.labels[...] = self.found
        self.strokes.clear()
        self._stroke, self._last = [], None

    def _change(self, index: Index, blocks: Labels) -> Change:
        middle = self.step // 2
        flat = np.ravel_multi_index(tuple(index), blocks.shape[:3]) if index.size else np.zeros(0, dtype=int)
        return Change(
            flat.astype(np.uint32), blocks[tuple(index)][..., middle, middle, middle].astype(np.uint8)
        )

    def write(self, path: Path) -> None:
        """Write the labels whole, in the axes and on the voxels that they came in.

        Raises
        ------
        StapeskitError
            The file was changed elsewhere since it was last read or written here.
        """
        import os

        from ct_inertia.scan.label_file import write_segmentation

        check_unchanged(path, self._stamp)
        draft = path.with_name(f".{path.name}.new")
        write_segmentation(draft, [self.labels], self.labels.shape, self.scan_from_index)
        os.replace(draft, path)
        self._stamp = stamp(path)

    def opened(self, path: Path) -> None:
        """Take a file as the one that these labels were read from."""
        self._stamp = stamp(path)


@dataclass(frozen=True)
class Change:
    """Voxels of the picture that changed: flat index [s, a, r] and new label."""

    index: NDArray[np.uint32]
    values: Labels


def shown_part(labels: Labels, spacing_mm: Array) -> tuple[tuple[slice, slice, slice], int]:
    """Return the part of labels around the stapes that a browser can show, and its step.

    The step is 1 unless the stapes alone has more voxels than `MOST_VOXELS`.
    """
    used = [np.flatnonzero((labels == 1).any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
    used = [one if one.size else np.array([0, n - 1]) for one, n in zip(used, labels.shape, strict=True)]
    for margin in (_MARGIN_MM, 0.5 * _MARGIN_MM, 0.0):
        low, high = [], []
        for axis, (one, n) in enumerate(zip(used, labels.shape, strict=True)):
            away = 4 + int(margin / spacing_mm[2 - axis])
            low.append(max(0, int(one[0]) - away))
            high.append(min(n, int(one[-1]) + 1 + away))
        size = np.array(high) - low
        if np.prod(size) <= MOST_VOXELS:
            break
    step = max(1, int(np.ceil((np.prod(size) / MOST_VOXELS) ** (1.0 / 3.0))))
    size = np.maximum(size // step, 1) * step
    parts = [slice(a, a + int(n)) for a, n in zip(low, size, strict=True)]
    return (parts[0], parts[1], parts[2]), step


def _brush(radius: int, normal: int | None) -> Index:
    """Return the offsets (n, 3) of a ball, or of a disc across an axis."""
    ticks = np.arange(-radius, radius + 1)
    offsets = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = (offsets**2).sum(axis=1) <= radius * radius
    if normal is not None:
        inside &= offsets[:, normal] == 0
    return offsets[inside]
