"""How well the stated noise of repeats is known itself, from how it scatters between them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from legacy.stapeskit.arrays import Array

# Lines between which noise is compared: a Hann window correlates neighbours.
_APART = 2
# Fewest lines and readings a line that show the scatter of a noise estimate.
_LEAST_LINES = 16
_LEAST_CELLS = 4
# Above so many degrees of freedom a noise estimate counts as known.
_MOST_FREEDOM = 200.0


def stated_freedom(pieces: Iterator[Array]) -> float:
    """Return the degrees of freedom of standard deviations that were estimated; infinite when they are exact.

    Parameters
    ----------
    pieces : iterator of ndarray, (take, channel, n)
        Logarithms of the stated variances at runs of lines; NaN where missing.

    Notes
    -----
    What a factor for each take and one for each channel leaves of the logarithm has, for a variance that was
    estimated with f degrees of freedom, the variance psi'(f / 2) times the share of freedom that is left
    (Bartlett and Kendall 1946, J. R. Stat. Soc. Suppl. 8:128). Steps over two lines count: noise that really
    differs runs smoothly.
    """
    values = []
    for logs in pieces:
        whole = np.all(np.isfinite(logs), axis=0)
        takes, count = len(logs), np.sum(whole, axis=0)
        filled = np.where(whole[None], logs, 0.0)
        safe = np.maximum(count, 1)
        rows = filled.sum(axis=1) / safe
        columns = filled.sum(axis=0) / takes
        interaction = np.where(whole[None], filled - rows[:, None] - columns[None] + rows.mean(axis=0), 0.0)
        both = whole[:, _APART:] & whole[:, :-_APART]
        steps = np.where(both[None], interaction[:, :, _APART:] - interaction[:, :, :-_APART], 0.0)
        number = np.sum(both, axis=0)
        freedom = 2.0 * (takes - 1) * (number - 1.0)
        good = number * takes >= _LEAST_CELLS * takes
        values.append(np.sum(steps**2, axis=(0, 1))[good] / freedom[good])
    scatter = np.concatenate(values) if values else np.zeros(0)
    if len(scatter) < _LEAST_LINES:
        return np.inf
    return _freedom(float(np.median(scatter)))


def _freedom(trigamma: float) -> float:
    """Return f with psi'(f / 2) = ``trigamma``."""
    from scipy.special import polygamma

    if trigamma <= float(polygamma(1, 0.5 * _MOST_FREEDOM)):
        return np.inf
    low, high = 0.0, np.log(_MOST_FREEDOM)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if polygamma(1, 0.5 * np.exp(middle)) > trigamma else (low, middle)
    return float(np.exp(low))


def inverse_moments(freedom: float, takes: int) -> tuple[float, float]:
    """Return mean and relative variance of the true variance over the geometric mean of estimated ones.

    Parameters
    ----------
    freedom : float
        Of each estimate.
    takes : int
        How many estimates the geometric mean is made of.

    Notes
    -----
    With w the product of (f / chi2_f)^(1/n) over n estimates, E[w] = (f / 2) (G(f/2 - 1/n) / G(f/2))^n and
    E[w^2] = (f / 2)^2 (G(f/2 - 2/n) / G(f/2))^n, G the gamma function.
    """
    from scipy.special import gammaln

    half = 0.5 * freedom
    if not np.isfinite(freedom) or half <= 2.0 / takes + 0.1:
        return 1.0, 0.0
    first = np.log(half) + takes * (gammaln(half - 1.0 / takes) - gammaln(half))
    second = 2.0 * np.log(half) + takes * (gammaln(half - 2.0 / takes) - gammaln(half))
    return float(np.exp(first)), float(np.expm1(second - 2.0 * first))
