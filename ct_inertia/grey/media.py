"""What lies between the bodies of a scene: fluid, soft tissue, filled voids, a stated coat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ct_inertia.bodies import Grey, Mask, Moments
from ct_inertia.calibrated import calibrated
from ct_inertia.find.distance import capped_distance
from ct_inertia.grey.fields import blur, local_ratio, share_above
from ct_inertia.grey.moments import effect
from ct_inertia.grey.plate_plane import FacePlane, beside_stapes, face_plane, is_flat
from ct_inertia.grey.start import Start, grown
from stapeskit.arrays import Array
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from ct_inertia.grey.scene import SceneFit, Window

_LEAST_VOID = 12  # voxels of a closed void; fewer are noise
_DENSEST = 0.85  # of bone's contrast: what is denser is bone
_MEDIUM_SIGMAS = 2.0  # widths of the blur over which a medium is averaged
_CLEAR = (0.4, 0.05)  # share of bodies below which a voxel shows a medium: on the stapes' side, anywhere
_MEETING_VOXELS = 1.8  # between the middles of voxels of two masks that touch
_TOUCH_SIGMAS = 1.5  # widths of the blur about their border in which a fluid fills what bone leaves
_BEYOND_EDGES = 1e-3  # share of bodies below which not even a wrong blur passes for a medium
_STRONG = 0.08  # of bone's contrast: more than what a wrong blur leaves next to an edge
_LEAST_PART = 0.01  # of the voxels there that must stand out
_LEAST_MEDIUM = calibrated("media.least_share")
_FILLED_SD = calibrated("media.filled_sd")
_MIDDLE = 0.75  # of the largest share of a hollow: voxels that its filling is read from
_VOID_SD = calibrated("media.void_sd")
_STANDS_OUT = 3.0  # standard deviations from which a void counts as filled
_REPORTED = 5e-4  # share of the volume from which a medium is named
_USUAL_MM, _USUAL_GREY = 0.035, 0.15  # mucosa of the middle ear: 20 to 50 um, attenuating like water
_NOTHING = 1e-7  # share of bone beyond which a coat is not followed: 5.2 widths of the blur


@dataclass(frozen=True)
class Coat:
    """A soft coat of even thickness on bone; ``grey`` is its contrast over that of bone.

    Attributes
    ----------
    thickness_mm, thickness_sd_mm, grey, grey_sd : float
    """

    thickness_mm: float
    thickness_sd_mm: float
    grey: float
    grey_sd: float


@dataclass
class Media:
    """Media of a scene while it is fitted; arrays [z, y, x] on the part of the box that `Start` chose.

    Attributes
    ----------
    coat : Coat or None
    voids : ndarray of bool or None
        Closed hollows of the stapes.
    touching : ndarray of bool or None
        Where no air is left between a fluid and the stapes.
    plane : FacePlane or None
        The face of a plate near the stapes; None without a plate and for a fluid.
    soft : ndarray of float32 or None
        Grey value of the medium in each voxel, before bodies take their share of it.
    void_share : ndarray of float32
        Blurred share of the hollows.
    void_grey, void_sd : float
        Grey value of what fills them above air.
    """

    coat: Coat | None = None
    voids: Mask | None = None
    touching: Mask | None = None
    plane: FacePlane | None = None
    soft: Grey | None = None
    void_share: Grey | None = None
    void_grey: float = 0.0
    void_sd: float = 0.0
    seen: Grey | None = field(default=None)

    @classmethod
    def around(cls, start: Start, coat: Coat | None) -> Media:
        """Look for closed hollows, and for plastic that touches the stapes."""
        touching, plane = None, None
        if "plate" in start.masks:
            plane = face_plane(start)
            plane = plane if is_flat(plane) else None
            gap = start.distances["plate"] + start.distances["stapes"]
            meet = gap < np.float32(_MEETING_VOXELS * start.spacing.max())
            if plane is None and meet.any():
                width = _TOUCH_SIGMAS * start.sigma_mm
                touching = capped_distance(meet, start.spacing[::-1], 1.4 * width) < np.float32(width)
        return cls(
            coat if coat is not None and coat.thickness_mm > 0.0 else None, _hollows(start), touching, plane
        )

    def plastic(self, fit: SceneFit, field: Grey, window: Window) -> Grey:
        """Return the share of plastic, or of a fluid that was taken for it, in the voxels of a window.

        The face of a plate is held to its plane near the stapes, where its own grey values show it badly; a
        fluid fills what the bone leaves where it touches.
        """
        bones = np.zeros_like(field)
        for name in fit.names[: fit.names.index("plate")]:
            np.maximum(bones, fit.bodies[name][window], out=bones)
        body = share_above(field, fit.side("plate")[window])
        if self.plane is not None:
            first = tuple(part.start for part in window)
            depth = self.plane.depth(field.shape, fit.start.spacing, first)
            behind = np.clip(depth * np.float32(1.0 / fit.start.spacing.mean()) + np.float32(0.5), 0.0, 1.0)
            body = np.where(beside_stapes(fit.start, window, fit.sigma_mm), behind, body)
        elif self.touching is not None:
            body = np.where(self.touching[window], np.float32(1.0), body)
        return np.minimum(body, np.float32(1.0) - bones)

    def image(self, window: Window) -> Grey | np.float32:
        """Return the grey values of all media in a window."""
        return np.float32(0.0) if self.seen is None else self.seen[window]

    def soft_image(self, shares: Mapping[str, Grey]) -> Grey | np.float32:
        """Return the grey values of the soft medium alone, where bodies leave room for it."""
        if self.soft is None:
            return np.float32(0.0)
        return np.asarray(self.soft * np.clip(1.0 - sum(shares.values()), 0.0, 1.0), dtype=np.float32)

    def as_shares(self, contrast: float) -> dict[str, float]:
        """Return what was fitted, as shares of the stapes' contrast."""
        shares = {"void": self.void_grey / contrast} if self.void_grey else {}
        if self.soft is not None:
            shares["soft"] = float(np.percentile(np.abs(self.soft), 99.0)) / contrast
        if self.coat is not None:
            shares["coat_mm"] = self.coat.thickness_mm
        return shares

    def follow(self, fit: SceneFit, renew: bool) -> None:
        """Fit the media to what the bodies leave; the soft one only with ``renew``: it is slow."""
        seen: Grey | None = None
        if self.coat is not None:
            seen = np.float32(self.coat.grey * fit.contrasts["stapes"]) * coat_share(
                fit, self.coat.thickness_mm
            )
        if self.voids is not None:
            rest = fit.data - fit.bones()
            rest = rest if seen is None else rest - seen
            self._fill_voids(fit, rest, self.voids)
            if self.void_grey and self.void_share is not None:
                filled = np.float32(self.void_grey) * self.void_share
                seen = filled if seen is None else seen + filled
        if renew:
            rest = fit.data - fit.bones()
            self._find_soft(fit, rest if seen is None else rest - seen)
        if self.soft is not None:
            clear = np.asarray(self.soft_image(fit.shares), dtype=np.float32)
            seen = clear if seen is None else seen + clear
        self.seen = None if seen is None else np.asarray(seen, dtype=np.float32)

    def _fill_voids(self, fit: SceneFit, rest: Grey, voids: Mask) -> None:
        """Fit one grey value to all closed hollows."""
        start = fit.start
        inside = np.where(voids, np.float32(1.0) - fit.bodies["stapes"], np.float32(0.0))
        self.void_share = blur(inside, fit.sigma_mm, start.spacing)
        # In the middle of a hollow: at its rim the bone counts as larger until the filling is known.
        there = self.void_share > np.float32(_MIDDLE * float(self.void_share.max()))
        share, left = self.void_share[there].astype(float), rest[there]
        square = float(share @ share) + 1e-30
        self.void_grey = float(share @ left) / square
        bone = float(fit.shares["stapes"][voids].mean())
        model = _VOID_SD * fit.contrasts["stapes"] * bone / max(1.0 - bone, 0.05)
        self.void_sd = float(np.sqrt(start.noise**2 * start.correlation / square + model**2))
        if self.void_grey < _STANDS_OUT * self.void_sd:
            self.void_grey = 0.0
        self.void_sd = float(np.hypot(self.void_sd, _FILLED_SD * self.void_grey))

    def _find_soft(self, fit: SceneFit, rest: Grey) -> None:
        """Average what bodies leave where they hardly fill a voxel; keep what stands out of the noise."""
        start, contrast = fit.start, fit.contrasts["stapes"]
        total = sum(fit.shares.values())
        clear = ((total < _CLEAR[0]) & (start.basin != 0)) | (total < _CLEAR[1])
        free = np.where(clear & start.near, 1.0 - total, 0.0).astype(np.float32)
        if self.void_share is not None:
            free[self.void_share > 0.05] = 0.0
        width = _MEDIUM_SIGMAS * fit.sigma_mm / start.spacing
        mean = local_ratio(free * rest, free * free, width, 0.02)
        independent = max(1.0, float(np.prod(2.0 * np.sqrt(np.pi) * width)))
        scatter = start.noise * np.sqrt(start.correlation / independent)
        least = max(_LEAST_MEDIUM * contrast, 3.0 * scatter)
        close = start.distances["stapes"] <= np.float32(start.reach_mm)
        seen = [
            np.count_nonzero((np.abs(mean) > np.float32(most)) & close & (total < np.float32(share)))
            > _LEAST_PART * np.count_nonzero(close & (total < np.float32(share)))
            for share, most in (
                (_BEYOND_EDGES, max(2.0 * _LEAST_MEDIUM * contrast, 5.0 * scatter)),
                (_CLEAR[1], max(_STRONG * contrast, 5.0 * scatter)),
            )
        ]
        if self.soft is None and not any(seen):
            return
        kept = np.clip((np.abs(mean) - np.float32(least)) / np.float32(least), 0.0, 1.0) * start.near
        most = np.float32(_DENSEST * contrast)
        self.soft = (np.clip(mean, -most, most) * kept).astype(np.float32)


def coat_share(fit: SceneFit, thickness_mm: float) -> Grey:
    """Return the blurred share of a coat of even thickness on every bone.

    Notes
    -----
    Along the normal x of a plane surface the blurred bone is m = Phi(-x / s), bone and coat together are
    Phi((t - x) / s), so that the coat adds Phi(Phi^-1(m) + t / s) - m. m is the image of the fitted bodies,
    so curvature enters by the distance of its level sets.
    """
    from scipy.special import ndtr, ndtri

    bone = np.zeros_like(fit.data)
    for name, one in fit.shares.items():
        if name != "plate":
            bone += one
    share = np.zeros_like(fit.data)
    there = bone > np.float32(_NOTHING)
    values = np.minimum(bone[there].astype(float), 1.0 - _NOTHING)
    share[there] = ndtr(ndtri(values) + thickness_mm / fit.sigma_mm) - values
    return share


def coat_sd_share(fit: SceneFit, own: Mask) -> Grey | None:
    """Return one sd of a stated coat's share on the stapes' side; None without a coat."""
    coat = fit.media.coat
    if coat is None:
        return None
    shell = coat_share(fit, coat.thickness_mm)
    thicker = coat_share(fit, coat.thickness_mm + coat.thickness_sd_mm) - shell
    return np.where(own, np.hypot(coat.grey_sd * shell, coat.grey * thicker), 0.0).astype(np.float32)


def coat_notice(fit: SceneFit, transform: Array, moments: Moments) -> Notice:
    """Report that bare bone is assumed, and what a usual mucosa would change."""
    own = fit.side("stapes") & (fit.start.distances["stapes"] <= np.float32(fit.start.reach_mm))
    usual = np.where(own, np.float32(_USUAL_GREY) * coat_share(fit, _USUAL_MM), np.float32(0.0))
    share = 100.0 * effect(usual, transform, moments)[0] / moments.volume_mm3
    text = (
        f"Bare bone is assumed. A mucosa of {1e3 * _USUAL_MM:.0f} um with {100.0 * _USUAL_GREY:.0f} % of "
        f"the contrast of bone would count as {share:.1f} % of the volume: state it with --coat where the "
        "sample was not cleaned."
    )
    return Notice("bare_bone_assumed", text)


def media_notices(fit: SceneFit, soft_share: Grey, moments: Moments, transform: Array) -> list[Notice]:
    """Report fluid or soft tissue that was subtracted, and hollows that are or may be filled."""
    notices = []
    soft = 100.0 * effect(soft_share, transform, moments)[0] / moments.volume_mm3
    if abs(soft) > 100.0 * _REPORTED or fit.media.touching is not None:
        wet = (
            " A fluid touches it, which is modelled as a body of its own."
            if fit.media.touching is not None
            else ""
        )
        text = (
            f"Fluid or soft tissue lies around the stapes: {soft:.2f} % of its volume were subtracted as a "
            f"smooth medium.{wet} The budget holds what remains (surroundings). Dry the sample and scan it "
            "again for a better value."
        )
        notices.append(Notice("soft_surroundings", text))
    media = fit.media
    if media.void_share is None:
        return notices
    hollow = effect(media.void_share, transform, moments)[0] / moments.volume_mm3
    doubt = 100.0 * hollow * media.void_sd / fit.contrasts["stapes"]
    if media.void_grey:
        text = (
            f"The closed hollows of the stapes ({100.0 * hollow:.1f} % of its volume) are filled, with "
            f"{100.0 * media.void_grey / fit.contrasts['stapes']:.0f} % of the contrast of bone: fluid or "
            f"marrow. It was subtracted, and the budget holds {doubt:.2f} % for it (voids). Its mass is "
            "left out: dry the sample, or add it as a point mass (--add-mass)."
        )
        notices.append(Notice("void_filled", text))
    elif doubt > 100.0 * _REPORTED:
        text = (
            f"Closed hollows of the stapes ({100.0 * hollow:.1f} % of its volume) are about as narrow as "
            "the blur: whether air or fluid fills them is not visible. Air is assumed, and the budget "
            f"holds {doubt:.2f} % for it (voids). Scan with smaller voxels, or dry the sample."
        )
        notices.append(Notice("void_filling_unknown", text))
    return notices


def _hollows(start: Start) -> Mask | None:
    """Return the closed hollows of the stapes, grown by a voxel; None where there are none."""
    import cc3d

    labels = cc3d.connected_components(~start.masks["stapes"], connectivity=6)
    count = np.bincount(labels.ravel())
    count[0] = 0
    for axis in range(3):
        for end in (0, -1):
            count[np.unique(np.take(labels, end, axis=axis))] = 0
    hollow = np.asarray((count > _LEAST_VOID)[labels])
    return grown(hollow) if hollow.any() else None
