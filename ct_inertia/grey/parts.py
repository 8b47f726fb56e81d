"""The share of the stapes in each voxel of a fitted scene, and the subtracted background."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ct_inertia.grey.bone import BoneLevel, bone_level
from ct_inertia.grey.media import coat_sd_share
from ct_inertia.grey.scene import SceneFit
from ct_inertia.voxels.fields import Grey
from ct_inertia.voxels.masks import Mask
from stapeskit.arrays import Array


@dataclass(frozen=True, eq=False)
class StapesParts:
    """What a fitted scene gives the stapes, on its part of the box; shares of the stapes' contrast.

    Attributes
    ----------
    fit : SceneFit
    level : BoneLevel
    own : ndarray of bool, [z, y, x]
        The stapes' side of the borders to other bodies.
    foreign, behind : ndarray of float32, [z, y, x]
        Blur of other bodies on its side, and its own on theirs.
    excess : ndarray of float32, [z, y, x]
        Grey values less everything that is not the stapes.
    residual : ndarray of float32, [z, y, x]
    soft : ndarray of float32, [z, y, x]
        Soft medium that was subtracted.
    coat_sd : ndarray of float32, [z, y, x], or None
    """

    fit: SceneFit
    level: BoneLevel
    own: Mask
    foreign: Grey
    behind: Grey
    excess: Grey
    residual: Grey
    soft: Grey
    coat_sd: Grey | None

    @classmethod
    def of(cls, fit: SceneFit) -> StapesParts:
        """Subtract everything that is not the stapes, and choose its level."""
        own, others, zero = fit.own, fit.bones(but="stapes"), np.float32(0.0)
        tails = others
        if fit.media.plane is not None and not fit.media.plane.wets:
            tails = others - np.float32(fit.contrasts["plate"]) * fit.shares["plate"]
        left = fit.data - others - fit.media.image
        level = bone_level(fit, left * np.float32(1.0 / fit.contrasts["stapes"]))
        unit = np.float32(1.0 / level.contrast)
        soft = fit.media.soft_image(fit)  # zeros that take no memory where there is none
        return cls(
            fit=fit,
            level=level,
            own=own,
            foreign=np.where(own, tails * unit, zero),
            behind=np.where(fit.start.within_reach & ~own, fit.shares["stapes"], zero),
            excess=left * unit,
            residual=fit.residual * unit,
            soft=soft if fit.media.soft is None else np.where(own, soft * unit, zero),
            coat_sd=coat_sd_share(fit),
        )

    @property
    def transform(self) -> Array:
        """Index x, y, z to scan coordinates, mm, (4, 4)."""
        return self.fit.start.grid.scan_from_index

    @property
    def integrand(self) -> Grey:
        """The stapes' share: as measured on its side, as modelled behind the border to other bodies."""
        return np.where(self.own, self.excess, self.behind)

    def where_own(self, amount: Grey) -> Grey:
        """Return an amount [z, y, x] on the stapes' side, 0 elsewhere."""
        return np.where(self.own, amount, np.float32(0.0))
