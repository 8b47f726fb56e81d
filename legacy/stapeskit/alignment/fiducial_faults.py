"""What is wrong with a set of fiducials: one mistyped, two exchanged, mirrored, or in another unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from legacy.stapeskit.alignment.exchanged_points import best_order, cycles
from legacy.stapeskit.alignment.paired_points import kabsch, misfits
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import StapeskitError
from legacy.stapeskit.warnings import Notice

# Probability of residuals below which fiducials are reported as inconsistent; 1 of 1000 right sets is.
INCONSISTENT = 1e-3
# Errors below 50 um are below the accuracy of marks and are not reported where no sd is stated.
_NOTICEABLE_MM = 0.05
# Twice the log likelihood by which explanations may differ and both be named: 20 to 1.
_ALIKE = 6.0
# Keeps the logarithm of exact data finite.
_ROUNDING = 1e-24
# How many times smaller another order must leave the sum of squares where no sd is stated.
_FAR_BETTER = 100.0


@dataclass(frozen=True)
class Explanation:
    """One way to explain fiducials that do not fit.

    Attributes
    ----------
    kind : str
        ``wrong`` (one fiducial), ``swapped`` (two), ``mirrored`` or ``scaled``.
    members : tuple of int
        The fiducials concerned.
    energy : float
        Weighted sum of squared residuals that is left.
    cost : float
        What the explanation must gain: for its parameters and for being one of many.
    size_mm : float
        How far the fiducial lies from where the others put it; the scale for ``scaled``.
    offset_mm : ndarray, (3,)
        The same as a vector, in target axes.
    """

    kind: str
    members: tuple[int, ...]
    energy: float
    n_dof: int
    cost: float
    size_mm: float = 0.0
    offset_mm: Array | None = None


def explanations(a: Array, b: Array, weights: Array) -> list[Explanation]:
    """Return every explanation by one fault, with what it leaves unexplained.

    Parameters
    ----------
    a, b : ndarray, (n, 3)
        Paired points, mm; at least 4.
    weights : ndarray, (n,)
        1 / sd^2, or ones.
    """
    count = len(a)
    free = 3 * count - 6
    cost = 3.0 + 2.0 * np.log(count)
    energies, residuals = misfits(a, b, np.where(np.eye(count, dtype=bool), 0.0, weights))
    offsets = -residuals[np.arange(count), np.arange(count)]
    suspects = [
        Explanation(
            "wrong", (out,), energy, free - 3, cost, float(np.linalg.norm(offsets[out])), offsets[out]
        )
        for out, energy in enumerate(energies.tolist())
    ]
    pairs = np.array(list(combinations(range(count), 2)))
    orders = np.tile(np.arange(count), (len(pairs), 1))
    np.put_along_axis(orders, pairs, pairs[:, ::-1], axis=1)
    cost = 2.0 * np.log(len(pairs))
    suspects += [
        Explanation("swapped", (i, j), energy, free, cost, float(np.linalg.norm(b[i] - b[j])))
        for (i, j), energy in zip(pairs.tolist(), misfits(a, b[orders], weights)[0].tolist(), strict=True)
    ]
    energy = float(misfits(a * [1.0, 1.0, -1.0], b, weights)[0])
    suspects.append(Explanation("mirrored", (), energy, free, 1.0))
    scale, energy = _scale(a, b, weights)
    suspects.append(Explanation("scaled", (), energy, free - 1, 1.0, scale))
    return suspects


def best(suspects: Sequence[Explanation], stated: bool) -> tuple[Explanation, list[Explanation]]:
    """Return the likeliest explanation, and those that the data cannot distinguish from it."""
    freedom = float(max(explanation.n_dof for explanation in suspects))

    def score(candidate: Explanation) -> float:
        if stated:
            return candidate.energy + candidate.cost
        return float(freedom * np.log(max(candidate.energy, _ROUNDING) / candidate.n_dof) + candidate.cost)

    ordered = sorted(suspects, key=score)
    alike = [candidate for candidate in ordered if score(candidate) < score(ordered[0]) + _ALIKE]
    return ordered[0], alike


def _scale(a: Array, b: Array, weights: Array) -> tuple[float, float]:
    """Return the scale that fits best (Umeyama 1991, doi:10.1109/34.88573, Eq. 42) and its energy."""
    rotation, _, _ = kabsch(a, b, weights)
    share = weights / np.sum(weights)
    a0, b0 = a - share @ a, b - share @ b
    turned = a0 @ rotation.T
    scale = float(np.sum(weights[:, None] * turned * b0) / np.sum(weights[:, None] * turned**2))
    return scale, float(np.sum(weights[:, None] * (scale * turned - b0) ** 2))


def check_size(a: Array, b: Array, source: str, to: str) -> None:
    """Refuse paired points whose distances differ by so much that the units must differ.

    Raises
    ------
    StapeskitError
        The median ratio of distances is beyond 1.5 or below 1 / 1.5; a factor of 1000 is reported as mm and m
        mixed.
    """
    pairs = np.array(list(combinations(range(len(a)), 2)))
    first = np.linalg.norm(a[pairs[:, 0]] - a[pairs[:, 1]], axis=1)
    second = np.linalg.norm(b[pairs[:, 0]] - b[pairs[:, 1]], axis=1)
    ratio = float(np.median(first / np.maximum(second, 1e-300)))
    if 1.0 / 1.5 < ratio < 1.5:
        return
    raise StapeskitError.of(
        f"the fiducials of the {source} and {to} frames",
        "both in mm, with the same distances between them",
        f"distances that are {ratio:.4g} times as large in the {source} frame",
        next_step=unit_hint(ratio, source, to) or "Check which fiducial is which, and the units",
    )


def unit_hint(ratio: float, source: str, to: str) -> str:
    """Name the mixed-up unit when sizes differ by a factor that units make; empty otherwise."""
    for factor, small, large in ((1000.0, "m", "um"), (25.4, "inches", ""), (10.0, "cm", "")):
        if abs(ratio / factor - 1.0) < 0.2:
            return f"The {to} coordinates seem to be in {small}" + (
                f", or those of the {source} frame in {large}" if large else ""
            )
        if abs(ratio * factor - 1.0) < 0.2:
            return f"The {source} coordinates seem to be in {small}" + (
                f", or those of the {to} frame in {large}" if large else ""
            )
    return ""


def fault_notices(
    suspects: Sequence[Explanation],
    rotation: Array,
    energy: float,
    names: Sequence[str],
    stated: bool,
) -> list[Notice]:
    """Test the residuals of the fiducials and name the fault that explains them best.

    Parameters
    ----------
    rotation : ndarray, (3, 3)
        Of the fit of all.
    energy : float
        Weighted sum of squares that the fit of all leaves.
    stated : bool
        Whether the weights are absolute.

    Notes
    -----
    With stated sd: chi2 of the fit of all, p < 0.001. Without, the others' scatter is the only scale: F test
    of the three coordinates of one fiducial (or of the improvement by an exchange), corrected for the number
    of candidates (Cook and Weisberg 1982, Residuals and Influence in Regression, section 2.2).
    """
    free = 3 * sum(explanation.kind == "wrong" for explanation in suspects) - 6
    usable = [
        explanation for explanation in suspects if explanation.kind != "mirrored" and explanation.n_dof > 0
    ]
    if not usable:
        return []
    first, alike = best(usable, stated)
    if stated:
        spread = float(np.sqrt(energy / free))
        if not inconsistent(energy, free):
            return []
        text = f"the fiducials disagree by {spread:.1f} times their sd_mm"
        if first.energy < 0.5 * energy:
            text += f"; {_words(first, alike, names, rotation)}"
        text += "; the covariance of the registration was enlarged accordingly."
        return [Notice("fiducials_inconsistent", text)]
    if not _significant(first, energy, free):
        return []
    others = np.sqrt(first.energy / first.n_dof)
    text = f"{_words(first, alike, names, rotation)}; the others scatter by {others * 1e3:.2g} um."
    return [Notice("fiducials_inconsistent", text)]


def clear_improvement_limit(energy: float, stated: bool) -> float:
    """Return the weighted sum of squares from which on another explanation is surely better than one."""
    return energy - _ALIKE if stated else energy / _FAR_BETTER


def refuse_exchanged(
    a: Array,
    b: Array,
    weights: Array,
    energy: float,
    stated: bool,
    names: Sequence[str],
    left_out: float = np.inf,
) -> None:
    """Refuse paired points that fit only in another order.

    Parameters
    ----------
    a, b : ndarray, (n, 3)
    weights : ndarray, (n,)
    energy : float
        Weighted sum of squares that the order as given leaves.
    stated : bool
        Whether the weights are absolute.
    left_out : float
        What the best of the faults of a single point leaves.

    Raises
    ------
    StapeskitError
        Names are exchanged: which, by cycles.
    """
    free = 3 * len(a) - 6
    if free < 3 or (stated and not inconsistent(energy, free)):
        return
    if not stated and np.sqrt(energy / np.sum(weights)) < _NOTICEABLE_MM:
        return
    order, after = best_order(a, b, weights)
    moved = cycles(order)
    if not moved or after > left_out:
        return
    if stated:
        if inconsistent(after, free):
            return
    elif after * _FAR_BETTER > energy:
        return
    listed = "; ".join(_cycle_words(cycle, names) for cycle in moved)
    raise StapeskitError.of(
        "the names of the fiducials",
        "those of the same points in both frames",
        f"{listed} (residual {np.sqrt(energy / np.sum(weights)):.3g} mm as given, "
        f"{np.sqrt(after / np.sum(weights)):.3g} mm in that order)",
        next_step="Correct the names, or the order of the reference coordinates",
    )


def _cycle_words(cycle: Sequence[int], names: Sequence[str]) -> str:
    if len(cycle) == 2:
        return f"{names[cycle[0]]} and {names[cycle[1]]} exchanged"
    steps = [
        f"{names[first]} is {names[second]}"
        for first, second in zip(cycle, (*cycle[1:], cycle[0]), strict=True)
    ]
    return "a cycle: " + ", ".join(steps)


def inconsistent(energy: float, n_dof: int) -> bool:
    """Return whether a sum of squares in units of sd is too large for noise (p < 0.001)."""
    from scipy.special import chdtri

    return n_dof > 0 and energy > float(chdtri(n_dof, INCONSISTENT))


def _significant(explanation: Explanation, energy: float, free: int) -> bool:
    from scipy.special import fdtrc

    count = free // 3 + 2
    scatter = max(explanation.energy, _ROUNDING) / explanation.n_dof
    gain = max(energy - explanation.energy, 0.0)
    if explanation.kind == "scaled":
        p = float(fdtrc(1, explanation.n_dof, gain / scatter))
        return p < INCONSISTENT and abs(explanation.size_mm - 1.0) > 1e-3
    if explanation.size_mm < _NOTICEABLE_MM:
        return False
    if explanation.kind == "wrong":
        return count * float(fdtrc(3, explanation.n_dof, gain / 3.0 / scatter)) < INCONSISTENT
    return count**2 / 2.0 * float(fdtrc(free, free, energy / explanation.n_dof / scatter)) < INCONSISTENT


def _words(first: Explanation, alike: Sequence[Explanation], names: Sequence[str], rotation: Array) -> str:
    """Describe what explains the misfit."""
    same = [explanation for explanation in alike if explanation.kind == first.kind]
    if first.kind == "scaled":
        return (
            f"distances between the references are {first.size_mm:.4f} times those that the vibrometer sees; "
            "check the voxel size of the scan and the scale of the vibrometer"
        )
    if first.kind == "swapped":
        i, j = (names[place] for place in first.members)
        return f"fiducials {i} and {j} seem to be exchanged; check their names"
    if len(same) > 1:
        listed = ", ".join(names[place] for candidate in same for place in candidate.members)
        return f"one of the fiducials {listed} is off by about {first.size_mm:.3g} mm, they cannot tell which"
    return (
        f"fiducial {names[first.members[0]]} lies {first.size_mm:.3g} mm from where the others put it"
        f"{_cell(first, rotation)}; check its coordinates or leave it out"
    )


def _cell(explanation: Explanation, rotation: Array) -> str:
    """Name the one coordinate that would explain the whole offset, as a mistyped cell does."""
    if explanation.offset_mm is None:
        return ""
    scatter = np.sqrt(explanation.energy / explanation.n_dof) if explanation.n_dof else 0.0
    sides = ((-rotation.T @ explanation.offset_mm, "_mm"), (explanation.offset_mm, "_ref_mm"))
    hits = []
    for offset, end in sides:
        axis = int(np.argmax(np.abs(offset)))
        rest = float(np.linalg.norm(np.delete(offset, axis)))
        if rest < max(0.05 * abs(offset[axis]), 3.0 * scatter if scatter < 0.1 * abs(offset[axis]) else 0.0):
            hits.append(f"{'xyz'[axis]}{end} too {'large' if offset[axis] > 0.0 else 'small'} by "
                        f"{abs(offset[axis]):.4g} mm")  # fmt: skip
    return f" (as with {' or '.join(hits)})" if hits else ""


def undo_mirror(target: str, source: str) -> str:
    """Return what to do when the frames that points tie are mirror images of each other."""
    if source == "plate":
        return (
            "Undo the mirrored axis of the scan with {mirror} x, y or z, or correct the plate's coordinates"
        )
    step = (
        "Undo the mirrored axis with {mirror} x, y or z (scanning heads often count one axis the other way)"
    )
    if target != "scan":
        return step
    scan = "when the slices of the scan are in reverse order, mirror the scan where it is read, by ct2mass"
    return f"{step}; {scan}. A side of the ear that you know shows which of the two it is"


def refuse_mirrored(
    suspects: Sequence[Explanation],
    energy: float,
    total_weight: float,
    stated: bool,
    frames: tuple[str, str],
    names: Sequence[str],
) -> None:
    """Refuse points that fit far better as a mirror image than as they are, or with one other fault.

    Raises
    ------
    StapeskitError
        One of the two frames is left-handed.
    """
    usable = [explanation for explanation in suspects if explanation.n_dof > 0]
    _, alike = best(usable, stated)
    mirror = next((candidate for candidate in alike if candidate.kind == "mirrored"), None)
    if mirror is None or mirror.energy > 0.25 * energy:
        return
    proper, flipped = (np.sqrt(3.0 * value / total_weight) for value in (energy, mirror.energy))
    rivals = [names[candidate.members[0]] for candidate in alike if candidate.kind == "wrong"]
    also = f"; or correct fiducial {' or '.join(rivals)}, which alone says so" if len(rivals) == 1 else ""
    raise StapeskitError.of(
        f"the coordinates of the {frames[1]} frame",
        "right-handed",
        f"points that fit only as a mirror image (residual {proper:.3g} mm as given, "
        f"{flipped:.3g} mm mirrored)",
        next_step=f"{undo_mirror(*frames)}{also}",
    )
