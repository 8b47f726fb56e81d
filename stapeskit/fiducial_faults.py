"""Find what is wrong with a set of fiducials: a mirror image, exchanged names, another scale, one mistyped.

Every cause is a changed set of points with few free parameters, taken as likely by what it leaves. One
without a free parameter that leaves nothing but noise is certain, and the fiducials are refused, as are those
that no pose brings within a millimetre. The rest is named in a warning.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.paired_points import kabsch, misfits
from stapeskit.warnings import Notice

INCONSISTENT = 1e-3
"""Probability of residuals below which fiducials are reported as inconsistent: 1 of 1000 right sets is."""
_INCONSISTENT_SD = 3.0902  # the same of a normal distribution
MOST_RESIDUAL_MM = 1.0
"""Root mean square residual of inconsistent fiducials from which on they are refused: a third of a stapes."""

_THIN = 0.02  # of their extent: flatter points count as coplanar, since their mirror image fits as well
_NOTICEABLE_MM = 0.05  # the accuracy of marks: smaller errors are not reported where no sd is stated
_CONSPICUOUS = 4.0  # times that accuracy: scatter of 12 degrees of freedom exceeds it by chance in 3e-6
_SCALE = 1e-3  # smaller differences of scale are not named
_PRICE = 5.0  # of a free parameter, in units of chi2: as much is gained by chance in 2.5 % of right sets
_ALIKE = 6.0  # twice the log likelihood (20 to 1) by which causes differ that cannot be distinguished
_MOST_LEFT = 0.1  # of the misfit that a cause with parameters may leave where it leaves more than noise
_FAR_BETTER = 100.0  # ratio of the sums of squares of a cause without parameters, where no sd is stated
_ROUNDING = 1e-24  # keeps the ratios of exact data finite
_UNITS = {"m": 1000.0, "inches": 25.4, "cm": 10.0, "um": 1e-3}  # mm


@dataclass(frozen=True)
class Pairs:
    """Paired points (n, 3) with weights (n,), 1 / sd^2 or ones, and the sum of squares of the fit of all.

    ``flat_mm`` is the largest distance of a target point from the best plane through all of them; ``stated``
    says whether the weights are absolute.
    """

    source_mm: Array
    target_mm: Array
    weights: Array
    chi2: float
    flat_mm: float
    stated: bool
    names: tuple[str, ...]
    source: str
    to: str

    def __len__(self) -> int:
        return len(self.source_mm)

    @property
    def n_dof(self) -> int:
        """Degrees of freedom of the fit of all."""
        return 3 * len(self) - 6

    @property
    def coplanar(self) -> bool:
        """Whether a mirror image fits as well."""
        extent = float(np.max(np.linalg.norm(self.target_mm - self.target_mm.mean(axis=0), axis=1)))
        noise = 4.0 / np.sqrt(float(np.median(self.weights))) if self.stated else 0.0
        return len(self) < 4 or self.flat_mm < max(_THIN * extent, noise)

    def rms_mm(self, chi2: float) -> float:
        """Return the root mean square length of the residuals that belongs to a sum of squares."""
        return float(np.sqrt(chi2 / np.sum(self.weights)))


@dataclass(frozen=True)
class Cause:
    """What may be wrong, in words, and the sum of squares that it leaves.

    It has ``parameters`` and is one of ``number`` alike. One without parameters is a ``refusal``: thing,
    expected, next step; a single wrong fiducial has a ``name`` and is off by ``size_mm``.
    """

    words: str
    chi2: float
    parameters: int = 0
    number: int = 1
    refusal: tuple[str, str, str] = ("", "", "")
    name: str = ""
    size_mm: float = np.inf


def inconsistent(chi2: float, n_dof: int) -> bool:
    """Return whether a sum of squares in units of sd is too large for noise (p < 0.001).

    Its cube root is normal to 2 % of the limit (Wilson and Hilferty 1931, doi:10.1073/pnas.17.12.684); to
    load scipy.special takes a third of the time of a check of the inputs.
    """
    if n_dof < 1:
        return False
    variance = 2.0 / (9.0 * n_dof)
    return (chi2 / n_dof) ** (1.0 / 3.0) > 1.0 - variance + _INCONSISTENT_SD * variance**0.5


def notices_of(pairs: Pairs) -> list[Notice]:
    """Return the warnings about a fit of fiducials.

    Raises
    ------
    StapeskitError
        Sizes differ, names are exchanged, a frame is left-handed, or residuals exceed a millimetre.
    """
    notices, count = [], len(pairs)
    _check_units(pairs)
    if pairs.coplanar:
        why = f"all fiducials within {pairs.flat_mm:.3g} mm of one plane"
        why = f"only {count} fiducials" if count < 4 else why
        text = f"{why}: a mirrored coordinate system would fit as well; add a fiducial off the plane."
        notices.append(Notice("fiducials_coplanar", text))
    if pairs.stated and not inconsistent(pairs.chi2, pairs.n_dof):
        return notices
    words = _best_cause(pairs) if count > 3 else ""
    why = "no single cause explains it" if count > 3 else "three cannot tell which (add a fourth)"
    rms_mm, want = pairs.rms_mm(pairs.chi2), f"in agreement within {MOST_RESIDUAL_MM:g} mm"
    if rms_mm > MOST_RESIDUAL_MM:
        got = f"{rms_mm:.3g} mm (root mean square residual)"
        raise StapeskitError.of("the fiducials", want, got, "", f"Check them: {words or why}")
    size = float(np.sqrt(pairs.chi2 / pairs.n_dof))
    if pairs.stated:
        words = (
            f"the fiducials disagree by {size:.1f} times their sd_mm; {words or why}; the covariance of the "
            "registration was enlarged accordingly"
        )
    elif size > _CONSPICUOUS * _NOTICEABLE_MM:
        words = words or f"the coordinates of the fiducials scatter by {size:.2g} mm; {why}"
    return [*notices, Notice("fiducials_inconsistent", f"{words}.")] if words else notices


def _check_units(pairs: Pairs) -> None:
    """Refuse points of the same shape, mirrored or not, whose sizes differ by a factor beyond 1.5."""
    mirrored = replace(pairs, source_mm=pairs.source_mm * [1.0, 1.0, -1.0])
    scale, left = min(map(_scale, (pairs, mirrored)), key=lambda found: found[1])
    centred = pairs.target_mm - np.average(pairs.target_mm, axis=0, weights=pairs.weights)
    if 1.0 / 1.5 < scale < 1.5 or left > 0.01 * np.sum(pairs.weights[:, None] * centred**2):
        return
    readings = [
        f"the {frame} coordinates seem to be in {unit}"
        for frame, seen in ((pairs.source, 1.0 / scale), (pairs.to, scale))
        for unit, factor in _UNITS.items()
        if abs(seen * factor - 1.0) < 0.2
    ]
    raise StapeskitError.of(
        f"the fiducials of the {pairs.source} and {pairs.to} frames",
        "both in mm, with the same distances between them",
        f"distances that are {1.0 / scale:.4g} times as large in the {pairs.source} frame",
        next_step=f"Give mm: {' or '.join(readings)}" if readings else "Check which is which, and the units",
    )


def _best_cause(pairs: Pairs) -> str:
    """Return the words of the most likely cause, empty without one.

    Raises
    ------
    StapeskitError
        The cause is certain.
    """
    likely = [cause for cause in _causes(pairs) if _is_likely(pairs, cause)]
    if not likely:
        return ""
    left = min(one.chi2 / (pairs.n_dof - one.parameters) for one in likely)
    scale = 1.0 if pairs.stated else max(left, _ROUNDING)
    weights = [one.chi2 / scale + _PRICE * one.parameters + 2.0 * np.log(one.number) for one in likely]
    best = likely[int(np.argmin(weights))]
    alike = [one.name for one in likely if one.name and one.chi2 < best.chi2 + _ALIKE * scale]
    thing, expected, step = best.refusal
    if thing:
        also = f"; or correct fiducial {alike[0]}, which alone shows it" if len(alike) == 1 else ""
        before, after = pairs.rms_mm(pairs.chi2), pairs.rms_mm(best.chi2)
        got = f"{best.words} (residual {before:.3g} mm as given, {after:.3g} mm so)"
        raise StapeskitError.of(thing, expected, got, "", step + also)
    if best.name and len(alike) > 1:
        listed = ", ".join(alike)
        return f"one of the fiducials {listed} is off by about {best.size_mm:.3g} mm, which one is open"
    return best.words


def _causes(pairs: Pairs) -> Iterator[Cause]:
    """Yield what may be wrong with four fiducials or more."""
    source, target, weights, count = pairs.source_mm, pairs.target_mm, pairs.weights, len(pairs)
    if not pairs.coplanar:
        thing = f"the coordinates of the {pairs.source} frame"
        refusal = (thing, "right-handed", undo_mirror(pairs.to, pairs.source))
        left = float(misfits(source * [1.0, 1.0, -1.0], target, weights)[0])
        yield Cause("points that fit only as a mirror image", left, refusal=refusal)
    same = "those of the same points in both frames"
    refusal = ("the names of the fiducials", same, "Correct the names, or the order of the references")
    couples = list(combinations(range(count), 2))
    orders = np.tile(np.arange(count), (len(couples), 1))
    for order, (one, other) in zip(orders, couples, strict=True):
        order[[one, other]] = other, one
    lefts = misfits(source, target[orders], weights)[0]
    for left, (one, other) in zip(lefts.tolist(), couples, strict=True):
        words = f"{pairs.names[one]} and {pairs.names[other]} exchanged"
        yield Cause(words, left, number=len(couples), refusal=refusal)
    scale, left = _scale(pairs)
    if abs(scale - 1.0) > _SCALE:
        words = (
            f"distances between the references are {scale:.4f} times those that the {pairs.source} frame "
            "has; check the voxel size of the scan and the scale of the vibrometer"
        )
        yield Cause(words, left, 1)
    left_out = np.where(np.eye(count, dtype=bool), 0.0, weights)
    sums, residuals, rotations = misfits(source, target, left_out)
    for place, name in enumerate(pairs.names):
        offset = residuals[place, place]
        size_mm = float(np.linalg.norm(offset))
        changes = (offset, -offset @ rotations[place])
        known, seen = (", ".join(f"{value:+.3g}" for value in part) for part in changes)
        words = (
            f"fiducial {name} lies {size_mm:.3g} mm from where the others put it (add {known} to x_ref_mm, "
            f"y_ref_mm, z_ref_mm, or {seen} to x_mm, y_mm, z_mm); correct it or leave it out"
        )
        yield Cause(words, float(sums[place]), 3, count, name=name, size_mm=size_mm)


def _scale(pairs: Pairs) -> tuple[float, float]:
    """Return the best scale of the source and what it leaves (Umeyama 1991, doi:10.1109/34.88573, Eq. 42)."""
    rotation, _ = kabsch(pairs.source_mm, pairs.target_mm, pairs.weights)
    points = (pairs.source_mm @ rotation.T, pairs.target_mm)
    source, target = (part - np.average(part, axis=0, weights=pairs.weights) for part in points)
    weights = pairs.weights[:, None]
    scale = float(np.sum(weights * source * target) / np.sum(weights * source**2))
    return scale, float(np.sum(weights * (scale * source - target) ** 2))


def _is_likely(pairs: Pairs, cause: Cause) -> bool:
    """Return whether a cause gains too much for chance; one without parameters must leave noise alone.

    With stated sd: chi2 of the fit of all, p < 0.001. Without, what a cause leaves is the only scale: F test
    of its gain, corrected for the number of such causes (Cook and Weisberg 1982, Residuals and Influence in
    Regression, section 2.2).
    """
    from scipy.special import chdtrc, fdtrc

    gain, n_dof = max(pairs.chi2 - cause.chi2, 0.0), pairs.n_dof - cause.parameters
    if pairs.stated:
        noise = not inconsistent(cause.chi2, n_dof)
        most = cause.chi2 < _MOST_LEFT * pairs.chi2 and cause.parameters > 0
        chance = float(chdtrc(max(cause.parameters, 1), gain))
        return cause.number * chance < INCONSISTENT and (noise or most)
    if cause.parameters == 0:
        return cause.chi2 * _FAR_BETTER < pairs.chi2 and pairs.rms_mm(pairs.chi2) > _NOTICEABLE_MM
    scatter = max(cause.chi2, _ROUNDING) / n_dof
    chance = float(fdtrc(cause.parameters, n_dof, gain / cause.parameters / scatter))
    return cause.number * chance < INCONSISTENT and cause.size_mm > _NOTICEABLE_MM


def undo_mirror(target: str, source: str) -> str:
    """Return what to do when the frames that points connect are mirror images of each other."""
    step = "Undo the mirrored axis{} with --mirror x, y or z{}, or "
    if source == "plate":
        return step.format(" of the scan", "") + "correct the plate's coordinates"
    step = step.format("", " (scanning heads often count one axis the other way)")
    step += "put exchanged columns into their order"
    if target != "scan":
        return step
    scan = "when the slices of the scan are in reverse order, mirror the scan where it is read, by ct2mass"
    return f"{step}; {scan}. A side of the ear that you know shows which of the two it is"
