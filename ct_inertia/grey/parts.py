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
    own : ndarray of bool, [z, y, x]
        The stapes' side of the borders to other bodies.
    excess : ndarray of float32, [z, y, x]
        Grey values less everything that is not the stapes.
    soft : ndarray of float32, [z, y, x], or None
        Soft medium that was subtracted.
    coat_sd : ndarray of float32, [z, y, x], or None
    """

    fit: SceneFit
    level: BoneLevel
    own: Mask
    excess: Grey
    soft: Grey | None
    coat_sd: Grey | None

    @classmethod
    def of(cls, fit: SceneFit) -> StapesParts:
        """Subtract everything that is not the stapes, and choose its level."""
        own, zero = fit.own, np.float32(0.0)
        excess = fit.data - fit.bones(but="stapes")
        excess -= fit.media.image
        level = bone_level(fit, excess * np.float32(1.0 / fit.contrasts["stapes"]))
        unit = np.float32(1.0 / level.contrast)
        excess *= unit
        return cls(
            fit=fit,
            level=level,
            own=own,
            excess=excess,
            soft=None if fit.media.soft is None else np.where(own, fit.media.soft_image(fit) * unit, zero),
            coat_sd=coat_sd_share(fit),
        )

    @property
    def residual(self) -> Grey:
        """What the model leaves of the grey values."""
        return self.fit.residual * np.float32(1.0 / self.level.contrast)

    @property
    def foreign(self) -> Grey:
        """Blur of other bodies on the stapes' side, but of a dry plate."""
        fit = self.fit
        tails = fit.bones(but="stapes")
        if fit.media.plane is not None and not fit.media.plane.wets:
            tails -= np.float32(fit.contrasts["plate"]) * fit.shares["plate"]
        tails *= np.float32(1.0 / self.level.contrast)
        return self.where_own(tails)

    @property
    def transform(self) -> Array:
        """Index x, y, z to scan coordinates, mm, (4, 4)."""
        return self.fit.start.grid.scan_from_index

    @property
    def behind(self) -> Grey:
        """Blur of the stapes on the side of other bodies."""
        there = self.fit.start.within_reach & ~self.own
        return np.where(there, self.fit.shares["stapes"], np.float32(0.0))

    @property
    def integrand(self) -> Grey:
        """The stapes' share: as measured on its side, as modelled behind the border to other bodies."""
        return np.where(self.own, self.excess, self.behind)

    def where_own(self, amount: Grey) -> Grey:
        """Return an amount [z, y, x] on the stapes' side, 0 elsewhere."""
        return np.where(self.own, amount, np.float32(0.0))
