"""The check of Kramers and Kronig: how much the stiffness of a causal ligament rises with its loss.

To first order d Re Z / d ln w = (2 / pi) Im Z where Im Z changes slowly with the frequency (Booij and Thoone
1982, Rheologica Acta 21:15). A constant loss factor with a constant stiffness breaks this.
"""

from __future__ import annotations

import numpy as np

from legacy.fitting.model.damping import DampingLaw


def causal_rise(law: DampingLaw, loss_factor: float, band: tuple[float, float]) -> float | None:
    """Return by which share of itself K must rise over a band; None for a law that is causal as it is.

    Parameters
    ----------
    loss_factor : float
        Im Z / Re Z.
    band : (float, float)
        Ends of the band, Hz.
    """
    if law.law.causal:
        return None
    return float(2.0 / np.pi * loss_factor * np.log(band[1] / band[0]))
