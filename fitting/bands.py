"""Do one K and one D hold over the whole band? Local factors of both, band by band, to first order.

In band b the dynamic stiffness is (1 + a_b) K + (1 + d_b) s D. The factors are further unknowns of the
likelihood, found by one step from its minimum; a factor common to all bands is K (or D) itself and is left
out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc

from fitting.data import Data
from fitting.solve import Fit
from fitting.unknowns import Parts, Unknown
from stapeskit.arrays import Array

SIGNIFICANT_P = 1e-3
"""Below it K and D do not hold over the band: 1 of 1000 right fits is called frequency dependent."""

_NOTHING = 1e-12  # of the information on both factors: at its limit, zero, one of K and D has none
_BANDS, _FEWEST_LINES = 5, 8  # bands to see a trend; lines a band: 48 equations for 12 unknowns


@dataclass(frozen=True)
class BandFactors:
    """Local stiffness and damping over those of the whole band; fields are keys of kd.json."""

    bands_hz: Array  # (bands, 2): first and last line of each band
    stiffness_factor: Array  # (bands,): their means, weighted by information, are 1
    stiffness_factor_sd: Array  # (bands,)
    damping_factor: Array  # (bands,): their means, weighted by information, are 1
    damping_factor_sd: Array  # (bands,)
    chi2: float  # of all factors being 1
    n_dof: int  # of all factors being 1
    p_value: float  # of all factors being 1

    def words(self) -> str:
        """Describe between which factors K and D vary."""
        parts = []
        for name, factor, sd in (
            ("K", self.stiffness_factor, self.stiffness_factor_sd),
            ("D", self.damping_factor, self.damping_factor_sd),
        ):
            ends = []
            for at in (int(np.argmin(factor)), int(np.argmax(factor))):
                low, high = self.bands_hz[at]
                ends.append(f"{factor[at]:.3f} ± {sd[at]:.1g} ({low:.0f} to {high:.0f} Hz)")
            parts.append(f"{name} by factors of {ends[0]} to {ends[1]}")
        return ", ".join(parts)


def _stiffer(inside: Array, value: float, parts: Parts, _data: Data) -> None:
    factor = 1.0 + value * inside
    parts.factor, parts.loss = parts.factor * factor, parts.loss / factor


def _lossier(inside: Array, value: float, parts: Parts, _data: Data) -> None:
    parts.loss = parts.loss * (1.0 + value * inside)


def band_factors(found: Fit) -> BandFactors | None:
    """Return the factors of five bands of equally many lines, fewer where lines are few.

    None below two bands, and where K or D is zero.
    """
    data, likelihood, theta = found.data, found.likelihood, found.theta
    bands = min(_BANDS, data.count // _FEWEST_LINES)
    if bands < 2:
        return None
    members = np.array_split(np.argsort(data.freq_hz, kind="stable"), bands)
    masks = [np.isin(np.arange(data.count), part).astype(float) for part in members]
    table = [Unknown("", "", "", 1.0, partial(how, mask)) for how in (_stiffer, _lossier) for mask in masks]
    new, free = likelihood.outside(theta, table)
    own = np.sum(new**2, axis=0).reshape(2, bands)
    if own.sum(axis=1).min() < _NOTHING * own.sum():  # K or D is zero, and has no factors
        return None
    contrasts = np.linalg.qr(np.column_stack([np.ones(bands), np.eye(bands)[:, 1:]]))[0][:, 1:]
    turned = np.kron(np.eye(2), contrasts)
    free = free @ turned
    level = max(1.0, found.level / found.noise)
    information = free.T @ free
    inverse = np.linalg.inv(information)
    values = -inverse @ (free.T @ likelihood.residuals(theta))
    share = own / own.sum(axis=1, keepdims=True)
    middle = np.eye(2 * bands) - block_diag(*(np.outer(np.ones(bands), own) for own in share))
    spread = middle @ turned
    factors = (1.0 + spread @ values).reshape(2, bands)
    sd = np.sqrt(np.maximum(level * np.diag(spread @ inverse @ spread.T), 0.0)).reshape(2, bands)
    chi2, n_dof = float(values @ information @ values) / level, 2 * bands - 2
    ends = np.array([[data.freq_hz[part].min(), data.freq_hz[part].max()] for part in members])
    return BandFactors(ends, factors[0], sd[0], factors[1], sd[1], chi2, n_dof, float(chdtrc(n_dof, chi2)))
