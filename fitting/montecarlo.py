"""Monte Carlo on request: refits of simulated repetitions of the measurement, every known error drawn."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fitting.draws import root_of
from fitting.likelihood import Likelihood, Prior
from fitting.plane import in_plane, posterior
from fitting.solve import fit
from stapeskit.arrays import Array

if TYPE_CHECKING:
    from fitting.result import KDFit


@dataclass(frozen=True)
class Scatter:
    """Errors (refits, p) of K11, K12, ..., Dnn, SI, and how many refits failed and were left out."""

    errors: Array
    failed: int

    @property
    def standard_deviation(self) -> Array:
        """Root mean square error of every parameter, (p,), SI."""
        return np.asarray(np.sqrt(np.mean(self.errors**2, axis=0)))


def scatter(
    result: KDFit, refits: int, seed: int = 0, report: Callable[[str, float | None], None] | None = None
) -> Scatter:
    """Repeat a measurement and fit each repetition; ``report`` gets the duration after the first one.

    Notes
    -----
    A repetition has new shared errors; its true motion is that nearest to the fitted one on the equations
    with them, and channel noise is added. What is known of the ligament's plane is drawn about the fitted
    plane.
    """
    found, rng, started = result.found, np.random.default_rng(seed), time.monotonic()
    data, model, at = found.data, found.likelihood.model, found.at
    values, vectors = np.linalg.eigh(max(1.0, found.level) * data.covariance)
    noise = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    settled = replace(data, y=found.likelihood.look(found.theta)[3])
    errors, failed = [], 0
    for number in range(refits):
        truth = found.theta.copy()
        truth[at["shared"]] = rng.standard_normal(len(data.sources))
        exact = Likelihood(settled, model).look(truth)[3]
        draws = rng.standard_normal((2, *exact.shape)) * np.sqrt(0.5)
        y = exact + (noise @ (draws[0] + 1j * draws[1])[:, :, None])[:, :, 0]
        drawn = model
        if model.coupling is not None:
            prior = model.coupling
            off = root_of(prior.covariance) @ rng.standard_normal(len(prior.mean))
            drawn = replace(model, coupling=Prior(truth[at["coupling"]] + off, prior.covariance))
        try:
            tried = fit(replace(data, y=y), drawn, truth, robust=found.weights is not None)
            plane = in_plane(tried) if model.coupling is not None else None
            there = posterior(replace(found, theta=truth), result.plane, 4).estimate
            errors.append(posterior(tried, plane, 4).estimate - there)
        except np.linalg.LinAlgError:
            failed += 1
        if number == 0 and report is not None:
            whole = (time.monotonic() - started) * refits
            report(f"refitting {refits} repetitions, about {whole:.0f} s", None)
    return Scatter(np.array(errors).reshape(-1, len(result.values)), failed)
