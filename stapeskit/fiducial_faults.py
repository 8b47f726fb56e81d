"""Find what is wrong with a set of fiducials: other axes, exchanged names, a mirror image, one mistyped.

Explanations without a free parameter (other axes, another order, a mirror image) come first: when one of
them leaves nothing but noise it is certain, and the fiducials are refused. The rest is named in a warning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.paired_points import Pairs, kabsch, misfits, size_error, sizes_differ
from stapeskit.warnings import Notice

INCONSISTENT = 1e-3
"""Probability of residuals below which fiducials are reported as inconsistent: 1 of 1000 right sets is."""

_NOTICEABLE_MM = 0.05  # the accuracy of marks: smaller errors are not reported where no sd is stated
_ALIKE = 6.0  # twice the log likelihood (20 to 1) by which explanations differ that cannot be distinguished
_FAR_BETTER = 100.0  # ratio of the sums of squares of a certain explanation, where no sd is stated
_ROUNDING = 1e-24  # keeps the ratios of exact data finite
_MOST_POINTS = 16  # of more points, other axes and other orders are not searched


@dataclass(frozen=True)
class Wrong:
    """One fiducial left out.

    Attributes
    ----------
    place : int
    chi2, n_dof : float, int
        Of the fit of the others.
    offset_mm : ndarray, (3,)
        Where its target lies, minus where the others put it, in target axes.
    rotation : ndarray, (3, 3)
        Of the fit of the others.
    """

    place: int
    chi2: float
    n_dof: int
    offset_mm: Array
    rotation: Array


def inconsistent(chi2: float, n_dof: int) -> bool:
    """Return whether a sum of squares in units of sd is too large for noise (p < 0.001)."""
    from scipy.special import chdtri

    return n_dof > 0 and chi2 > float(chdtri(n_dof, INCONSISTENT))


def notices_of(pairs: Pairs) -> list[Notice]:
    """Return the warnings about a fit of fiducials.

    Raises
    ------
    StapeskitError
        Some fiducials are in other axes, names are exchanged, or one of the frames is left-handed.

    Notes
    -----
    With stated sd: chi2 of the fit of all, p < 0.001. Without, the others' scatter is the only scale: F test
    of the three coordinates of one fiducial, corrected for their number (Cook and Weisberg 1982, Residuals
    and Influence in Regression, section 2.2).
    """
    notices = []
    if pairs.coplanar:
        few = f"only {len(pairs)} fiducials"
        why = few if len(pairs) < 4 else f"all fiducials within {pairs.flat_mm:.3g} mm of one plane"
        text = f"{why}: a mirrored coordinate system would fit as well; add a fiducial off the plane."
        notices.append(Notice("fiducials_coplanar", text))
    if pairs.stated and not inconsistent(pairs.chi2, pairs.n_dof):
        return notices
    cause = ""
    if len(pairs) > 3:
        suspects = sorted(_each_left_out(pairs), key=lambda suspect: suspect.chi2)
        if pairs.rms_mm(pairs.chi2) > _NOTICEABLE_MM or pairs.stated:
            _refuse_certain(pairs, suspects)
        if sizes_differ(pairs.source_mm, pairs.target_mm):
            raise size_error(pairs.source_mm, pairs.target_mm, pairs.source, pairs.to)
        cause = _scale_cause(pairs, suspects[0]) or _wrong_cause(pairs, suspects)
    if pairs.stated:
        size = np.sqrt(pairs.chi2 / pairs.n_dof)
        several = (
            "three cannot tell which (add a fourth)" if len(pairs) == 3 else "no single cause explains it"
        )
        text = (
            f"the fiducials disagree by {size:.1f} times their sd_mm; {cause or several}; the covariance of "
        )
        notices.append(Notice("fiducials_inconsistent", f"{text}the registration was enlarged accordingly."))
    elif cause:
        notices.append(Notice("fiducials_inconsistent", f"{cause}."))
    return notices


def _each_left_out(pairs: Pairs) -> list[Wrong]:
    count = len(pairs)
    weights = np.where(np.eye(count, dtype=bool), 0.0, pairs.weights)
    chi2, residuals, rotations = misfits(pairs.source_mm, pairs.target_mm, weights)
    return [
        Wrong(place, float(chi2[place]), pairs.n_dof - 3, -residuals[place, place], rotations[place])
        for place in range(count)
    ]


@dataclass(frozen=True)
class Explanation:
    """A cause without a free parameter, its residual sum of squares, and its sentence.

    It is one of many alike, whose number (its logarithm) it must outweigh: 1 mirror image, n! orders, 47 axes
    for each of 2^n sets of points.
    """

    chi2: float
    log_number: float
    thing: str
    expected: str
    got: str
    next_step: str

    @property
    def weight(self) -> float:
        """Twice the negative logarithm of the likelihood, the choice among so many included."""
        return self.chi2 + 2.0 * self.log_number


def _refuse_certain(pairs: Pairs, suspects: Sequence[Wrong]) -> None:
    """Refuse fiducials that one explanation without a free parameter explains down to the noise."""
    tried = (_other_axes(pairs), _other_order(pairs), _mirror_image(pairs, suspects))
    sound = [one for one in tried if one and _explains(pairs, one.chi2, suspects[0], one.log_number)]
    if sound:
        best = min(sound, key=lambda one: one.weight)
        given, left = pairs.rms_mm(pairs.chi2), pairs.rms_mm(best.chi2)
        got = f"{best.got} (residual {given:.3g} mm as given, {left:.3g} mm so)"
        raise StapeskitError.of(best.thing, best.expected, got, "", best.next_step)


def _mirror_image(pairs: Pairs, suspects: Sequence[Wrong]) -> Explanation | None:
    if pairs.coplanar or not pairs.mirrored:
        return None
    chi2 = float(misfits(pairs.source_mm * [1.0, 1.0, -1.0], pairs.target_mm, pairs.weights)[0])
    rivals = [pairs.names[wrong.place] for wrong in suspects if _explains(pairs, wrong.chi2, suspects[0])]
    also = f"; or correct fiducial {rivals[0]}, the only one that shows it" if len(rivals) == 1 else ""
    thing, got = f"the coordinates of the {pairs.source} frame", "points that fit only as a mirror image"
    step = f"{undo_mirror(pairs.to, pairs.source)}{also}"
    return Explanation(chi2, 0.0, thing, "right-handed", got, step)


def _explains(pairs: Pairs, chi2: float, suspect: Wrong, log_number: float = 0.0) -> bool:
    """Return whether nothing but noise is left, and too much is gained for chance among so many."""
    if pairs.stated:
        gain = 2.0 * (log_number - np.log(INCONSISTENT))
        noise = not inconsistent(chi2, pairs.n_dof) and not inconsistent(chi2 - suspect.chi2, 3)
        return noise and pairs.chi2 - chi2 > gain
    scatter = max(suspect.chi2, _ROUNDING) / suspect.n_dof
    return chi2 * _FAR_BETTER < pairs.chi2 and chi2 / pairs.n_dof < _ALIKE * max(scatter, _ROUNDING)


def _signed_axes() -> Array:
    """Return the 47 other ways (47, 3, 3) to order and count three axes."""
    ways = [
        np.diag(signs)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return np.array(ways[1:])


def _other_axes(pairs: Pairs) -> Explanation | None:
    """Read some targets in other axes: every triple gives a pose, by which each target takes its axes."""
    count, ways = len(pairs), _signed_axes()
    if count > _MOST_POINTS:
        return None
    triples = np.array(list(combinations(range(count), 3)))
    rotation, shift, _ = kabsch(pairs.source_mm[triples], pairs.target_mm[triples], pairs.weights[triples])
    mapped = pairs.source_mm @ rotation.swapaxes(-1, -2) + shift[:, None, :]
    turned = np.einsum("wij,nj->wni", ways, pairs.target_mm)
    as_given = pairs.weights * np.sum((mapped - pairs.target_mm) ** 2, axis=-1)
    otherwise = pairs.weights * np.sum((mapped[:, None] - turned) ** 2, axis=-1)
    left = np.sum(np.minimum(as_given[:, None], otherwise), axis=-1)
    triple, way = np.unravel_index(int(np.argmin(left)), left.shape)
    which, axes = otherwise[triple, way] < as_given[triple], ways[way]
    if 2 * np.sum(which) > count:  # the other points read in the inverse axes are the same, but for the pose
        which, axes = ~which, axes.T
    if not np.any(which):
        return None
    target = np.where(which[:, None], pairs.target_mm @ axes.T, pairs.target_mm)
    listed = ", ".join(pairs.names[place] for place in np.flatnonzero(which))
    return Explanation(
        float(misfits(pairs.source_mm, target, pairs.weights)[0]),
        float(np.log(47.0) + count * np.log(2.0)),
        f"the references of the fiducials {listed}",
        f"in the axes of the {pairs.to} frame, as the others",
        f"coordinates that fit with {_axes_words(axes)}",
        "Correct these coordinates, or export all of them from one program",
    )


def _axes_words(axes: Array) -> str:
    """Describe axes (3, 3) in which coordinates were given."""
    names = [f"{letter}_ref_mm" for letter in "xyz"]
    order = np.argmax(np.abs(axes), axis=1).tolist()
    signs = [axes[row, column] for row, column in enumerate(order)]
    if order == [0, 1, 2]:
        changed = " and ".join(name for name, sign in zip(names, signs, strict=True) if sign < 0.0)
        between = " (RAS against LPS)" if signs == [-1.0, -1.0, 1.0] else ""
        return f"the other sign of {changed}{between}"
    moved = [name for place, name in enumerate(names) if order[place] != place]
    if signs == [1.0, 1.0, 1.0] and len(moved) == 2:
        return f"{' and '.join(moved)} exchanged"
    read = ", ".join(
        ("-" if sign < 0.0 else "") + "xyz"[place] for place, sign in zip(order, signs, strict=True)
    )
    return f"x, y, z read as {read}"


def _other_order(pairs: Pairs) -> Explanation | None:
    """Exchange names: every triple of targets gives a pose for the three sources that span most.

    The others follow by assignment. Of orders that fit alike the one that moves fewest points counts:
    symmetric sets have several.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist
    from scipy.special import gammaln

    count, same = len(pairs), tuple(range(len(pairs)))
    if count > _MOST_POINTS:
        return None
    source, target, weights = pairs.source_mm, pairs.target_mm, pairs.weights
    corners = list(max(combinations(range(count), 3), key=lambda triple: _area(source[list(triple)])))
    triples = np.array(list(permutations(range(count), 3)))
    rough = misfits(source[corners], target[triples], weights[corners])[0]
    likely = triples[np.argsort(rough)[:200]]
    rotations, shifts, _ = kabsch(source[corners], target[likely], weights[corners])
    orders = {
        tuple(linear_sum_assignment(cdist(source @ rotation.T + shift, target, "sqeuclidean"))[1].tolist())
        for rotation, shift in zip(rotations, shifts, strict=True)
    }
    orders.discard(same)
    if not orders:
        return None
    listed = sorted(orders)
    chi2 = misfits(source, target[np.array(listed)], weights)[0]
    alike = np.flatnonzero(chi2 < chi2.min() + _ALIKE)
    best = min(alike, key=lambda k: (sum(a != b for a, b in zip(listed[k], same, strict=True)), chi2[k]))
    return Explanation(
        float(chi2[best]),
        float(gammaln(count + 1)),
        "the names of the fiducials",
        "those of the same points in both frames",
        _order_words(listed[best], pairs.names),
        "Correct the names, or the order of the references",
    )


def _area(corners: Array) -> float:
    return float(np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])))


def _order_words(order: Sequence[int], names: Sequence[str]) -> str:
    """Say which names stand for which points; target order[k] is that of k."""
    exchanged = [(k, o) for k, o in enumerate(order) if k < o and order[o] == k]
    moved = [(k, o) for k, o in enumerate(order) if k != o and order[o] != k]
    words = [f"{names[one]} and {names[other]} exchanged" for one, other in exchanged]
    return "; ".join([*words, *(f"{names[one]} is {names[other]}" for one, other in moved)])


def undo_mirror(target: str, source: str) -> str:
    """Return what to do when the frames that points connect are mirror images of each other."""
    if source == "plate":
        return (
            "Undo the mirrored axis of the scan with --mirror x, y or z, or correct the plate's coordinates"
        )
    step = (
        "Undo the mirrored axis with --mirror x, y or z (scanning heads often count one axis the other way), "
        "or put exchanged columns into their order"
    )
    if target != "scan":
        return step
    scan = "when the slices of the scan are in reverse order, mirror the scan where it is read, by ct2mass"
    return f"{step}; {scan}. A side of the ear that you know shows which of the two it is"


def _scale_cause(pairs: Pairs, suspect: Wrong) -> str:
    """Name a wrong scale (Umeyama 1991, doi:10.1109/34.88573, Eq. 42) when it explains the misfit better."""
    from scipy.special import fdtrc

    rotation, _, _ = kabsch(pairs.source_mm, pairs.target_mm, pairs.weights)
    share = pairs.weights / np.sum(pairs.weights)
    turned = (pairs.source_mm - share @ pairs.source_mm) @ rotation.T
    target = pairs.target_mm - share @ pairs.target_mm
    weights = pairs.weights[:, None]
    scale = float(np.sum(weights * turned * target) / np.sum(weights * turned**2))
    chi2, n_dof = float(np.sum(weights * (scale * turned - target) ** 2)), pairs.n_dof - 1
    scatter = max(chi2, _ROUNDING) / n_dof
    gain = max(pairs.chi2 - chi2, 0.0)
    if pairs.stated:  # one parameter more, against three and a choice among n
        better = inconsistent(gain, 1) and chi2 + 1.0 < suspect.chi2 + 3.0 + 2.0 * np.log(len(pairs))
    else:
        better = float(fdtrc(1, n_dof, gain / scatter)) < INCONSISTENT
        better = better and scatter < max(suspect.chi2, _ROUNDING) / suspect.n_dof
    if not better or abs(scale - 1.0) < 1e-3:
        return ""
    return (
        f"distances between the references are {scale:.4f} times those that the {pairs.source} frame has; "
        "check the voxel size of the scan and the scale of the vibrometer"
    )


def _wrong_cause(pairs: Pairs, suspects: Sequence[Wrong]) -> str:
    """Return the one fiducial whose error explains the misfit, if there is one."""
    from scipy.special import fdtrc

    first, count = suspects[0], len(pairs)
    if first.n_dof < 1:
        return ""
    scatter = max(first.chi2, _ROUNDING) / first.n_dof
    size_mm = float(np.linalg.norm(first.offset_mm))
    if pairs.stated:
        if first.chi2 > 0.5 * pairs.chi2:
            return ""
        alike = [suspect for suspect in suspects if suspect.chi2 < first.chi2 + _ALIKE]
    else:
        gain = (pairs.chi2 - first.chi2) / 3.0 / scatter
        if size_mm < _NOTICEABLE_MM or count * float(fdtrc(3, first.n_dof, gain)) > INCONSISTENT:
            return ""
        factor = np.exp(_ALIKE / first.n_dof)
        alike = [suspect for suspect in suspects if suspect.chi2 <= factor * max(first.chi2, _ROUNDING)]
    if len(alike) > 1:
        listed = ", ".join(pairs.names[place] for place in sorted(suspect.place for suspect in alike))
        return f"one of the fiducials {listed} is off by about {size_mm:.3g} mm, they cannot tell which"
    cell = _cell(first, float(np.sqrt(scatter)), pairs)
    others = "" if pairs.stated else f"; the others scatter by {1e3 * np.sqrt(scatter):.2g} um"
    return (
        f"fiducial {pairs.names[first.place]} lies {size_mm:.3g} mm from where the others put it{cell}; "
        f"check its coordinates or leave it out{others}"
    )


def _cell(wrong: Wrong, scatter: float, pairs: Pairs) -> str:
    """Name the one coordinate that would explain the whole offset, as a mistyped cell does."""
    noise = scatter / np.sqrt(pairs.weights[wrong.place]) if pairs.stated else scatter
    hits = []
    for offset, end in ((-wrong.rotation.T @ wrong.offset_mm, "_mm"), (wrong.offset_mm, "_ref_mm")):
        axis = int(np.argmax(np.abs(offset)))
        size, rest = abs(offset[axis]), float(np.linalg.norm(np.delete(offset, axis)))
        if rest < max(0.05 * size, 3.0 * noise if noise < 0.1 * size else 0.0):
            sense = "large" if offset[axis] > 0.0 else "small"
            hits.append(f"{'xyz'[axis]}{end} too {sense} by {size:.4g} mm")
    return f" (as with {' or '.join(hits)})" if hits else ""
