"""What lies between the bodies of a scene: fluid, soft tissue, filled hollows, a stated coat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ct_inertia.calibrated import calibrated
from ct_inertia.grey.plate_plane import FacePlane, beside_stapes
from ct_inertia.grey.start import Start
from ct_inertia.voxels.distance import capped_distance
from ct_inertia.voxels.fields import Grey, blur, local_ratio, share_above
from ct_inertia.voxels.masks import Mask, Slices, grown, used_box, widened
from stapeskit.warnings import Notice

if TYPE_CHECKING:
    from ct_inertia.grey.scene import SceneFit

_STILL_VOXELS = 2e-3  # of the plane of a plate from round to round: a tenth of what noise leaves
_LEAST_VOID = 12  # voxels of a closed void; fewer are noise
_DENSEST = 0.85  # of bone's contrast: what is denser is bone
_MEDIUM_SIGMAS = 2.0  # widths of the blur over which a medium is averaged
_CLEAR = (0.4, 0.05)  # share of bodies below which a voxel shows a medium: on the stapes' side, anywhere
_MEETING_VOXELS = 1.8  # between the middles of voxels of two masks that touch
_TOUCH_SIGMAS = 1.5  # widths of the blur about their border in which a fluid fills what bone leaves
_BESIDE = 0.01  # share of bodies from which a voxel lies at an edge; beyond, what is measured is subtracted
_BEYOND_EDGES = 1e-3  # share of bodies below which not even a wrong blur passes for a medium
_STRONG = 0.08  # of bone's contrast: more than what a wrong blur leaves next to an edge
_LEAST_PART = 5e-4  # of the voxels there that must stand out: a drop of glue, a stump of a tendon
_LEAST_MEDIUM = calibrated("media.least_share")
_FILLED_SD = calibrated("media.filled_sd")
_MIDDLE = 0.75  # of the largest share of a hollow: voxels that its filling is read from
_VOID_SD = calibrated("media.void_sd")
_STANDS_OUT = 3.0  # standard deviations from which a void counts as filled
_REPORTED = 5e-4  # share of the volume from which a medium is named
_NOTHING = 1e-7  # share of bone beyond which a coat is not followed: 5.2 widths of the blur


@dataclass(frozen=True)
class Coat:
    """A soft coat of even thickness on bone; ``grey`` is its contrast over that of bone."""

    thickness_mm: float
    thickness_sd_mm: float
    grey: float
    grey_sd: float


USUAL_COAT = Coat(0.035, 0.015, 0.15, 0.05)
"""Mucosa of the middle ear: 20 to 50 um, attenuating like water."""


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
    void_share : ndarray of float32 or None
        Blurred share of the hollows.
    void_grey, void_sd : float
        Grey value of what fills them above air.
    image : ndarray of float32
        Grey values of all media.
    """

    coat: Coat | None
    voids: Mask | None
    touching: Mask | None
    plane: FacePlane | None
    image: Grey
    soft: Grey | None = None
    void_share: Grey | None = None
    void_grey: float = 0.0
    void_sd: float = 0.0

    @classmethod
    def around(cls, start: Start, coat: Coat | None) -> Media:
        """Look for closed hollows, and for plastic that touches the stapes."""
        touching, plane = None, start.face
        if "plate" in start.masks:
            gap = start.distances["plate"] + start.distances["stapes"]
            meet = gap < np.float32(_MEETING_VOXELS * start.spacing.max())
            if plane is None and meet.any():
                width = _TOUCH_SIGMAS * start.sigma_mm
                touching = capped_distance(meet, start.spacing[::-1], 1.4 * width) < np.float32(width)
        coat = coat if coat is not None and coat.thickness_mm > 0.0 else None
        return cls(
            coat,
            _hollows(start.masks["stapes"]),
            touching,
            plane,
            np.zeros(start.grey.shape, dtype=np.float32),
        )

    @property
    def wet(self) -> bool:
        """A fluid touches the stapes."""
        return self.touching is not None or (self.plane is not None and self.plane.wets)

    def plastic(self, fit: SceneFit, field: Grey, box: Slices) -> Grey:
        """Return the share of plastic, or of a fluid that was taken for it, in the voxels of a box.

        The face of a plate is held to its plane near the stapes, where its own grey values show it badly; a
        fluid fills what the bone leaves where it touches.
        """
        body = share_above(field, fit.side("plate", box))
        if self.plane is not None:
            behind = self.plane.share(field.shape, tuple(part.start for part in box))
            body = np.where(beside_stapes(fit.start, box), behind, body)
        elif self.touching is not None:
            body = np.where(self.touching[box], np.float32(1.0), body)
        bones = [fit.bodies[name][box] for name in fit.names if name != "plate"]
        return np.minimum(body, np.float32(1.0) - np.maximum.reduce(bones))

    def refine(self, fit: SceneFit) -> bool:
        """Fit the plane of a plate to what the scene leaves next to the stapes; return whether it rests."""
        if self.plane is None:
            return True
        before, self.plane = self.plane, self.plane.refined(fit)
        return abs(self.plane.offset_mm - before.offset_mm) < _STILL_VOXELS * float(fit.start.spacing.min())

    def soft_image(self, fit: SceneFit) -> Grey:
        """Return the grey values of the soft medium alone, where bodies leave room for it."""
        assert self.soft is not None  # noqa: S101 - asked for where there is one
        return np.asarray(self.soft * np.clip(1.0 - sum(fit.shares.values()), 0.0, 1.0), dtype=np.float32)

    def film_sd(self, fit: SceneFit) -> Grey:
        """Return what the grey values of the soft medium err by at the bone's edge where it is a thin film.

        They are means over some widths of the blur: they err by what they change by over one such width.
        """
        assert self.soft is not None  # noqa: S101 - asked for where there is one
        bodies = np.asarray(sum(fit.shares.values()))
        slopes = np.gradient(self.soft, *fit.start.spacing)
        steep = np.sqrt(sum(np.square(slope) for slope in slopes)) * _MEDIUM_SIGMAS * fit.sigma_mm
        beside = (bodies > _BESIDE) * np.clip(1.0 - bodies, 0.0, 1.0)
        return np.asarray(steep * beside, dtype=np.float32)

    def as_shares(self, contrast: float) -> dict[str, float]:
        """Return what was fitted, as shares of the stapes' contrast."""
        shares = {"void": self.void_grey / contrast} if self.void_grey else {}
        if self.soft is not None:
            shares["soft"] = float(np.percentile(np.abs(self.soft), 99.0)) / contrast
        if self.coat is not None:
            shares["coat_mm"] = self.coat.thickness_mm
        return shares

    def follow(self, fit: SceneFit, renew: bool) -> None:
        """Fit the media to what the bodies leave of the data; ``renew``: the soft one too, which is slow."""
        image = np.zeros(self.image.shape, dtype=np.float32)
        if self.coat is not None:
            grey = np.float32(self.coat.grey * fit.contrasts["stapes"])
            image += grey * coat_share(fit, self.coat.thickness_mm)
        if self.voids is not None:
            image += self._filling(fit, image, self.voids)
        if renew:
            self._find_soft(fit, image)
        if self.soft is not None:
            image += self.soft_image(fit)
        self.image = image

    def _filling(self, fit: SceneFit, image: Grey, voids: Mask) -> Grey:
        """Fit one grey value to all closed hollows, and return its image; ``image``: that of a coat."""
        start = fit.start
        inside = np.where(voids, np.float32(1.0) - fit.bodies["stapes"], np.float32(0.0))
        self.void_share = blur(inside, fit.spread_mm2, start.spacing, fit.near)
        # In the middle of a hollow: at its rim the bone counts as larger until the filling is known.
        there = np.flatnonzero(self.void_share > np.float32(_MIDDLE * float(self.void_share.max())))
        share, left = self.void_share.ravel()[there].astype(float), fit.rest(there) - image.ravel()[there]
        square = float(share @ share) + 1e-30
        grey = float(share @ left) / square
        bone = float(fit.shares["stapes"][voids].mean())
        model = _VOID_SD * fit.contrasts["stapes"] * bone / max(1.0 - bone, 0.05)
        sd = float(np.sqrt(start.noise**2 * start.correlation / square + model**2))
        self.void_grey = grey if grey >= _STANDS_OUT * sd else 0.0
        self.void_sd = float(np.hypot(sd, _FILLED_SD * self.void_grey))
        return np.float32(self.void_grey) * self.void_share

    def _find_soft(self, fit: SceneFit, image: Grey) -> None:
        """Average what the bodies and an image leave where they hardly fill a voxel; keep more than noise."""
        start, contrast = fit.start, fit.contrasts["stapes"]
        near = np.flatnonzero(start.near)
        total = np.asarray(sum(share.ravel()[near] for share in fit.shares.values()))
        clear = ((total < _CLEAR[0]) & (start.basin.ravel()[near] != 0)) | (total < _CLEAR[1])
        if self.void_share is not None:
            clear &= self.void_share.ravel()[near] <= 0.05
        free = np.where(clear, np.float32(1.0) - total, np.float32(0.0))
        top, bottom = (np.zeros(image.shape, dtype=np.float32) for _ in range(2))
        top.ravel()[near] = (fit.rest(near) - image.ravel()[near]) * free
        bottom.ravel()[near] = np.square(free)
        width = _MEDIUM_SIGMAS * fit.sigma_mm / start.spacing
        mean = local_ratio(top, bottom, width, 0.02, fit.near).ravel()[near]
        independent = max(1.0, float(np.prod(2.0 * np.sqrt(np.pi) * width)))
        scatter = start.noise * np.sqrt(start.correlation / independent)
        least = np.float32(max(_LEAST_MEDIUM * contrast, 3.0 * scatter))
        within = start.within_reach.ravel()[near]
        if self.soft is None and not any(
            _stands_out(mean[within & (total < share)], max(most * contrast, 5.0 * scatter))
            for share, most in ((_BEYOND_EDGES, 2.0 * _LEAST_MEDIUM), (_CLEAR[1], _STRONG))
        ):
            return
        kept = np.clip((np.abs(mean) - least) / least, 0.0, 1.0)
        most = np.float32(_DENSEST * contrast)
        self.soft = np.zeros(image.shape, dtype=np.float32)
        self.soft.ravel()[near] = np.clip(mean, -most, most) * kept


def _stands_out(means: Grey, most: float) -> bool:
    """Return whether more than a small part of some means (n,) pass a size."""
    return bool(np.count_nonzero(np.abs(means) > np.float32(most)) > _LEAST_PART * means.size)


def coat_share(fit: SceneFit, thickness_mm: float) -> Grey:
    """Return the blurred share of a coat of even thickness on every bone.

    Notes
    -----
    Along the normal x of a plane surface the blurred bone is m = Phi(-x / s), bone and coat together are
    Phi((t - x) / s), so that the coat adds Phi(Phi^-1(m) + t / s) - m. m is the image of the fitted bodies,
    so curvature enters by the distance of its level sets.
    """
    from scipy.special import ndtr, ndtri

    bone = np.sum([one for name, one in fit.shares.items() if name != "plate"], axis=0)
    share = np.zeros_like(fit.data)
    there = np.flatnonzero(bone > np.float32(_NOTHING))
    values = np.minimum(bone.ravel()[there], np.float32(1.0 - _NOTHING))
    share.ravel()[there] = ndtr(ndtri(values) + np.float32(thickness_mm / fit.sigma_mm)) - values
    return share


def coat_sd_share(fit: SceneFit) -> Grey | None:
    """Return one sd of a stated coat's share; None without a coat."""
    coat = fit.media.coat
    if coat is None:
        return None
    shell = coat_share(fit, coat.thickness_mm)
    thicker = coat_share(fit, coat.thickness_mm + coat.thickness_sd_mm) - shell
    return np.hypot(coat.grey_sd * shell, coat.grey * thicker).astype(np.float32)


def usual_coat(fit: SceneFit) -> Grey:
    """Return the share of bone that a usual mucosa would count as."""
    return np.float32(USUAL_COAT.grey) * coat_share(fit, USUAL_COAT.thickness_mm)


def coat_notice(share: float) -> Notice:
    """Report that bare bone is assumed, and what a usual mucosa would change, as a share of the volume."""
    text = (
        f"Bare bone is assumed. A mucosa of {1e3 * USUAL_COAT.thickness_mm:.0f} um with "
        f"{100.0 * USUAL_COAT.grey:.0f} % of the contrast of bone would count as {100.0 * share:.1f} % of "
        "the volume: state it with --coat where the sample was not cleaned."
    )
    return Notice("bare_bone_assumed", text)


def media_notices(fit: SceneFit, soft: float, hollow: float) -> list[Notice]:
    """Report fluid or soft tissue that was subtracted, and hollows that are or may be filled.

    ``soft``, ``hollow``: shares of the volume that the medium counts as, and that hollows are.
    """
    notices, media = [], fit.media
    around = []
    if soft > _REPORTED:
        share = f"{100.0 * soft:.2f} % of its volume was subtracted as a smooth medium."
        around.append(f"Fluid or soft tissue lies around the stapes: {share}")
    if media.wet:
        around.append("The plate or a fluid touches the stapes; it is modelled as a body of its own.")
    if around:
        text = (
            f"{' '.join(around)} The budget holds what remains (surroundings). Dry the sample, or lift it "
            "off the plate, and scan it again for a better value."
        )
        notices.append(Notice("soft_surroundings", text))
    if soft < -_REPORTED:
        text = (
            f"Next to the stapes the scan is darker than air, by {-100.0 * soft:.2f} % of its volume: edge "
            "enhancement (phase fringes, a sharpening filter) does that. It was fitted as a medium; the "
            "budget holds what remains (surroundings). Reconstruct without such a filter."
        )
        notices.append(Notice("grey_values_misfit", text))
    contrast = fit.contrasts["stapes"]
    budget = f"the budget holds {100.0 * hollow * media.void_sd / contrast:.2f} % for it (voids)"
    if media.void_grey:
        text = (
            f"The closed hollows of the stapes ({100.0 * hollow:.1f} % of its volume) are filled, with "
            f"{100.0 * media.void_grey / contrast:.0f} % of the contrast of bone: fluid or marrow. It was "
            f"subtracted, and {budget}. Its mass is left out: dry the sample, or add it as a point mass "
            "(--add-mass)."
        )
        notices.append(Notice("void_filling", text))
    elif hollow * media.void_sd / contrast > _REPORTED:
        text = (
            f"Closed hollows of the stapes ({100.0 * hollow:.1f} % of its volume) are about as narrow as the "
            f"blur: whether air or fluid fills them is not visible. Air is assumed, and {budget}. Scan with "
            "smaller voxels, or dry the sample."
        )
        notices.append(Notice("void_filling", text))
    return notices


def _hollows(stapes: Mask) -> Mask | None:
    """Return the closed hollows of a mask, grown by a voxel; None where there are none."""
    import cc3d

    box = widened(used_box(stapes), 1)
    labels = cc3d.connected_components(~stapes[box], connectivity=6)
    count = np.bincount(labels.ravel())
    count[0] = 0
    for axis in range(3):
        for end in (0, -1):
            count[np.unique(np.take(labels, end, axis=axis))] = 0
    hollow = np.zeros(stapes.shape, dtype=bool)
    hollow[box] = (count > _LEAST_VOID)[labels]
    return grown(hollow) if hollow.any() else None
