"""The surfaces that ct2mass leaves beside mass.json: stapes, plate, and other bone from the label volume."""

from __future__ import annotations

import io
import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.registration.mesh_distance import TriangleSurface
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault, StapeskitError
from legacy.stapeskit.records.measured_mass import LabelVolume

if TYPE_CHECKING:
    from legacy.stapeskit.records.mass_record import MassRecord
    from legacy.stapeskit.records.measured_mass import MeasuredMass

# Numbers of labels.nrrd (contract of files).
STAPES, PLATE, OTHER_BONE = 1, 2, 3
# Around the points, in which a surface of labels is made; and its largest box.
_MARGIN_MM = 1.0
_MOST_VOXELS = 60_000_000
# Bytes that a byte of deflate can become at most (1032), and what makes zlib expect the header of gzip.
_MOST_PACKED, _GZIP = 1100, 31
_TYPES = {"unsigned char": "u1", "uchar": "u1", "uint8": "u1", "uint8_t": "u1", "signed char": "i1",
          "int8": "i1", "short": "i2", "int16": "i2", "unsigned short": "u2", "uint16": "u2",
          "int": "i4", "int32": "i4", "unsigned int": "u4", "uint32": "u4"}  # fmt: skip
_SIGNS = {"left-posterior-superior": (1.0, 1.0, 1.0), "lps": (1.0, 1.0, 1.0),
          "right-anterior-superior": (-1.0, -1.0, 1.0), "ras": (-1.0, -1.0, 1.0),
          "left-anterior-superior": (1.0, -1.0, 1.0), "las": (1.0, -1.0, 1.0)}  # fmt: skip


@dataclass(frozen=True)
class ScanSurfaces:
    """The surfaces of a scan, all in scan coordinates, mm; each is read once, when it is asked for.

    Attributes
    ----------
    find : callable
        From a file's name to its path, which need not exist.
    labels_file : str or None
        Name of the label volume.
    memory : MeasuredMass or None
        A mass whose surfaces are in memory; no file is read then.
    """

    find: Callable[[str], Path]
    labels_file: str | None = "labels.nrrd"
    memory: MeasuredMass | None = None
    _read: dict[str, TriangleSurface | None] = field(default_factory=dict, repr=False, compare=False)
    _labels: dict[str, LabelVolume | None] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def beside(cls, mass_file: Path, mass: MassRecord | None = None) -> ScanSurfaces:
        """Return the surfaces in the folder of a mass.json, the labels by the name that it gives them."""
        labels = "labels.nrrd" if mass is None else mass.raw.get("labels_file", "labels.nrrd")
        named = labels if isinstance(labels, str) and Path(labels).name == labels else None
        return cls(lambda name: Path(mass_file).parent / name, named)

    @classmethod
    def of(cls, mass: MeasuredMass) -> ScanSurfaces:
        """Return the surfaces of a mass, from its folder or from memory."""
        if mass.file is not None:
            return cls.beside(mass.file, mass.record)
        return cls(Path, None, mass)

    def mesh(self, name: str) -> TriangleSurface | None:
        """Return ``stapes`` or ``plate``, or None when there is no such file.

        Raises
        ------
        KinematicsError
            The file holds no triangles.
        """
        if name not in self._read:
            self._read[name] = self._load_mesh(name)
        return self._read[name]

    def _load_mesh(self, name: str) -> TriangleSurface | None:
        if self.memory is not None:
            mesh = self.memory.meshes.get(name)
            return None if mesh is None else TriangleSurface(*mesh, f"surface of the {name}")
        path = self.find(f"{name}.ply")
        return read_mesh(path, name) if path.is_file() else None

    def bone_near(self, points_mm: Array) -> TriangleSurface | None:
        """Return the boundary of the other bone around points (n, 3), or None when there is none there."""
        if "labels" not in self._labels:
            self._labels["labels"] = self._load_labels()
        labels = self._labels["labels"]
        return None if labels is None else label_surface(labels, OTHER_BONE, points_mm)

    def _load_labels(self) -> LabelVolume | None:
        if self.memory is not None:
            return self.memory.labels()
        path = None if self.labels_file is None else self.find(self.labels_file)
        return read_labels(path) if path is not None and path.is_file() else None


def read_mesh(path: Path, name: str) -> TriangleSurface:
    """Read a triangle mesh, mm.

    Raises
    ------
    KinematicsError
        The file is missing, cannot be read, or holds no triangles.
    """
    path = Path(path)
    if not path.is_file():
        raise KinematicsError(
            Fault(f"the surface of the {name}", "an existing mesh", path, "", "Run ct2mass first")
        )
    import trimesh

    try:
        # From its bytes: pictures that a mesh names stay closed.
        content, kind = io.BytesIO(path.read_bytes()), path.suffix[1:].lower()
        mesh = trimesh.load_mesh(content, file_type=kind, process=False)
        vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)
        if not (len(faces) and faces.min() >= 0 and faces.max() < len(vertices)):
            raise ValueError("triangles without their corners")
        if not np.all(np.isfinite(vertices)):
            raise ValueError("corners that are not finite")
        return TriangleSurface(vertices, faces, f"surface of the {name}")
    except StapeskitError:
        raise
    except Exception as fault:
        raise KinematicsError(
            Fault(
                f"the surface of the {name}",
                "a triangle mesh",
                str(fault)[:80],
                path.name,
                "Run ct2mass anew",
            )
        ) from fault


def read_labels(path: Path) -> LabelVolume:
    """Read an attached NRRD label volume as ct2mass and 3D Slicer write it.

    Raises
    ------
    KinematicsError
        It is no NRRD, its header lacks a field, or its data are cut short.
    """
    raw = Path(path).read_bytes()
    head, _, data = raw.partition(b"\n\n")
    lines = head.decode("latin-1").splitlines()
    fields = {
        key.strip().lower(): value.strip(" =")
        for key, _, value in (line.partition(":") for line in lines[1:] if not line.startswith("#"))
    }
    try:
        if not lines or not lines[0].startswith("NRRD"):
            raise ValueError("no NRRD header")
        size = [int(part) for part in fields["sizes"].split()]
        axes = [_vector(part) for part in fields["space directions"].replace(")", ") ").split()]
        sign = np.array(_SIGNS[fields["space"].lower()])
        kind = np.dtype(_TYPES[fields["type"].lower()])
        if fields.get("endian", "little") == "big":
            kind = kind.newbyteorder(">")
        needed = math.prod(size) * kind.itemsize
        if min(size) < 1 or needed > _MOST_PACKED * len(data):
            raise ValueError(f"{len(data)} bytes for {' x '.join(map(str, size))} voxels")
        if fields["encoding"].lower() in ("gzip", "gz"):
            # As many bytes as the header declares, whatever the file would unpack to.
            data = zlib.decompressobj(_GZIP).decompress(data, needed)
        elif fields["encoding"].lower() != "raw":
            raise ValueError(f"encoding {fields['encoding']}")
        array = np.frombuffer(data, kind, math.prod(size)).reshape(size[::-1])
        origin = _vector(fields["space origin"])
        matrix = np.column_stack([*axes, origin]) * sign[:, None]
        if array.ndim != 3 or matrix.shape != (3, 4):
            raise ValueError(f"{array.ndim} dimensions")
        if not np.all(np.isfinite(matrix)) or np.linalg.matrix_rank(matrix[:, :3]) < 3:
            raise ValueError("directions that span no volume")
    except (KeyError, ValueError, OSError, EOFError, zlib.error) as fault:
        got = f"no field {fault}" if isinstance(fault, KeyError) else str(fault)[:80]
        raise KinematicsError(
            Fault(
                "the label volume", "an NRRD as ct2mass writes it", got, Path(path).name, "Run ct2mass anew"
            )
        ) from fault
    return LabelVolume(array, matrix)


def _vector(text: str) -> Array:
    return np.array([float(part) for part in text.strip("() ").split(",")])


def label_surface(labels: LabelVolume, label: int, points_mm: Array) -> TriangleSurface | None:
    """Return the boundary of one label around points (n, 3), scan mm; None when there is none nearby.

    Notes
    -----
    The mask is blurred by one voxel before its half level is taken, which takes the steps out: a plane is
    met within about 0.1 voxels (sd), edges are rounded within a voxel.
    """
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    matrix = labels.scan_from_index
    index = np.linalg.solve(matrix[:, :3], (np.asarray(points_mm) - matrix[:, 3]).T).T
    reach = np.ceil(_MARGIN_MM / labels.spacing_mm)
    size = np.array(labels.array.shape[::-1])
    low = np.clip(np.floor(index.min(axis=0) - reach), 0, size).astype(int)
    high = np.clip(np.ceil(index.max(axis=0) + reach) + 1, 0, size).astype(int)
    if np.any(high - low < 4) or np.prod((high - low).astype(float)) > _MOST_VOXELS:
        return None
    box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    mask = labels.array[box] == label
    if not 0 < np.count_nonzero(mask) < mask.size:
        return None
    blurred = gaussian_filter(mask.astype(np.float32), 1.0, mode="nearest")
    if not blurred.min() < 0.5 < blurred.max():
        return None
    vertices, faces, _, _ = marching_cubes(blurred, 0.5, gradient_direction="ascent")
    places = (vertices[:, ::-1] + low) @ matrix[:, :3].T + matrix[:, 3]
    surface = np.asarray(faces, dtype=np.int64)
    if _points_inward(blurred, vertices, surface, labels):
        surface = surface[:, ::-1]
    return TriangleSurface(places, surface, "surface of the bone")


def _points_inward(blurred: Array, vertices: Array, faces: NDArray[np.int64], labels: LabelVolume) -> bool:
    """Return whether most triangles point towards larger values, in index space seen in scan axes."""
    some = faces[:: max(1, len(faces) // 500)]
    corners = vertices[some][:, :, ::-1] @ labels.scan_from_index[:, :3].T
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    slopes = np.stack([np.gradient(blurred, axis=axis) for axis in range(3)], axis=-1)
    where = np.clip(np.rint(vertices[some].mean(axis=1)).astype(int), 0, np.array(blurred.shape) - 1)
    uphill = slopes[tuple(where.T)][:, ::-1] @ np.linalg.inv(labels.scan_from_index[:, :3])
    return float(np.sum(normal * uphill)) > 0.0
