"""What the coarse view of a scan shows: pieces of bone, one of them taken for the stapes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from legacy.ct_inertia.calibrated import calibrated
from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.segment.candidates import Piece, count_holes, surrounded, with_holes_of
from legacy.ct_inertia.segment.necks import Neck
from legacy.ct_inertia.segment.split_pieces import Markers
from legacy.ct_inertia.volume.coarse_view import CoarseScan, smooth_noise
from legacy.ct_inertia.volume.grid_operations import dilated
from legacy.ct_inertia.volume.volume import Volume
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import Fault
from legacy.stapeskit.warnings import Notice

_ABOVE_PLASTIC = calibrated("sight.above_plastic")
_THIN_WALL = calibrated("sight.thin_wall")
_PLASTIC_MARGIN = calibrated("sight.plastic_margin")


@dataclass(frozen=True)
class SearchOptions:
    """What a user can say about where the stapes is.

    Attributes
    ----------
    threshold : float or None
        Grey value between air and bone.
    seed_mm : ndarray, (3,), or None
        A point inside the stapes, scan coordinates.
    box_mm : ndarray, (6,), or None
        Two corners of the part of the scan to look at: x0, y0, z0, x1, y1, z1.
    labels : Volume or None
        A label volume made elsewhere; it says which voxels are stapes and plate.
    stapes_label, plate_label : int or None
        Their numbers in ``labels``; None: by the names of its segments, else 1 and 2.
    voxel_size_sd : float or None
        Relative standard uncertainty of the voxel size.
    """

    threshold: float | None = None
    seed_mm: Array | None = None
    box_mm: Array | None = None
    labels: Volume | None = None
    stapes_label: int | None = None
    plate_label: int | None = None
    voxel_size_sd: float | None = None


@dataclass(frozen=True)
class CoarseSegmentation:
    """What the coarse view shows.

    Attributes
    ----------
    scan : CoarseScan
    pieces : ndarray of int32, [z, y, x]
        Connected pieces of bone, coarse voxels.
    stapes : Piece
        The piece taken for the stapes; its ``label`` numbers it in ``pieces``.
    others : tuple of Piece
    air, bone : float
        First guess of the grey levels.
    plastic : float or None
    between : float
        Grey value above which a voxel counts as bone.
    markers : Markers or None
        Cores of the pieces, when they touch and had to be separated; numbered as in ``pieces``.
    method : str
        How the pieces were separated.
    notices : tuple of Notice
    neck : Neck or None
        The plane at a neck by which they were separated.
    cropped : bool
        Bone that the border of the scan crops was cut off the stapes.
    """

    scan: CoarseScan
    pieces: NDArray[np.int32]
    stapes: Piece
    others: tuple[Piece, ...]
    air: float
    bone: float
    plastic: float | None
    between: float
    markers: Markers | None = None
    method: str = "connected component"
    notices: tuple[Notice, ...] = field(default=())
    neck: Neck | None = None
    cropped: bool = False

    @property
    def at_neck(self) -> bool:
        """Whether a plane through a neck separated the pieces."""
        return self.neck is not None


def level_hypotheses(levels: Array, threshold: float | None) -> list[tuple[float, float | None, float]]:
    """Return the possible levels (air, plastic, bone), in the order in which to try them.

    First the brightest material is taken for bone, then the second brightest, and so on.
    """
    if threshold is not None:
        below, above = levels[levels < threshold], levels[levels >= threshold]
        if below.size == 0 or above.size == 0:
            raise CtInertiaError(
                Fault(
                    "{threshold}",
                    f"between the grey levels of air and bone ({levels[0]:.6g} and {levels[-1]:.6g})",
                    f"{threshold:g}",
                    next_step="Read the two levels off the viewer, or leave {threshold} out",
                )
            )
        plastic = float(below[-1]) if below.size > 1 else None
        return [(float(below[0]), plastic, float(above[-1]))]
    tried: list[tuple[float, float | None, float]] = []
    air = float(levels[0])
    for k in range(len(levels) - 1, 0, -1):
        # A material above half way from air to bone is bone of another density, or else a dense plate.
        bone, between = float(levels[k]), levels[1:k]
        middle = 0.5 * (air + bone)
        light, dense = between[between <= middle], between[between > middle]
        plastics = [float(light[-1]) if light.size else None, *(float(level) for level in dense)]
        tried += [(air, plastic, bone) for plastic in plastics]
    return tried


def between_levels(air: float, plastic: float | None, bone: float) -> float:
    """Return the grey value above which a voxel counts as bone."""
    middle = 0.5 * (air + bone)
    return middle if plastic is None else max(middle, plastic + _ABOVE_PLASTIC * (bone - plastic))


def count_piece_holes(sight: CoarseSegmentation, piece: Piece) -> Piece:
    """Count a piece's holes unless that was done; thin dark walls count where that leaves one hole."""
    if piece.holes is not None:
        return piece
    inside = sight.pieces[piece.box] == piece.label
    counted = with_holes_of(piece, inside, sight.scan.spacing_mm)
    if counted.holes == 1 or sight.scan.grey.shape != sight.pieces.shape:
        return counted
    return (
        replace(counted, holes=1, perforated=False)
        if count_holes(_thick(sight, piece.box, inside)) == 1
        else counted
    )


def _thick(sight: CoarseSegmentation, box: tuple[slice, ...], inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a piece with the darker voxels next to it: walls thinner than the blur are darker than bone."""
    contrast = sight.bone - sight.air
    low = sight.air + _THIN_WALL * contrast
    if sight.plastic is not None:
        low = max(low, sight.plastic + _PLASTIC_MARGIN * contrast)
    quiet = smooth_noise(sight.scan.grey[box], sight.scan.noise / contrast)
    return np.asarray(inside | (dilated(inside, 2) & (quiet > low)))


def classify_piece(sight: CoarseSegmentation, piece: Piece) -> Piece:
    """Count its holes, and see whether it surrounds other bone."""
    holed = count_piece_holes(sight, piece)
    if not holed.arched or not sight.others or holed.surrounds > 0.0:
        return holed
    return replace(holed, surrounds=surrounded(sight.pieces, holed))
