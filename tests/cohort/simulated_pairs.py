"""Cohorts with a planted law, in logarithms and as ears."""

from __future__ import annotations

import numpy as np

from pipeline.cohort.law import LogPairs


def cohort(
    rng,
    n=16,
    exponent=1.5,
    tau=0.12,
    sigma=0.2,
    error=(0.05, 0.07, 0.3),
    common=0.0,
    batches=0.0,
    pairs=0.0,
    heavy=False,
):
    """Return LogPairs of n ears and the true (x, y) of a further one.

    ``error`` is (sd of ln x, sd of ln y, correlation); ``common`` an error of all ears, ``batches`` one of
    every second ear (a scanner); ``pairs`` the correlation of the two ears of each subject.
    """
    people = n // 2 if pairs else n + 1
    alike = np.sqrt(pairs)
    index = np.repeat(np.arange(people), 2)[:n] if pairs else np.arange(n)

    def scatter(size):
        drawn = rng.standard_t(4, size) / np.sqrt(2.0) if heavy else rng.standard_normal(size)
        return drawn

    shared_x, shared_y = rng.standard_normal(people), scatter(people)
    x = tau * (alike * shared_x[index] + np.sqrt(1.0 - pairs) * rng.standard_normal(n))
    y = exponent * x + sigma * (alike * shared_y[index] + np.sqrt(1.0 - pairs) * scatter(n))
    further = tau * rng.standard_normal()
    truth = (further, exponent * further + sigma * float(scatter(1)[0]))
    sx, sy, r = error
    own = np.tile([[sx**2, r * sx * sy], [r * sx * sy, sy**2]], (n, 1, 1))
    noise = rng.multivariate_normal([0.0, 0.0], own[0], n) if sx or sy else np.zeros((n, 2))
    shared = np.zeros((n, 2, 2))
    shared[:, :, 0] = common
    shared[::2, :, 1] = batches
    noise = noise + shared @ rng.standard_normal(2)
    subject = index if pairs else np.arange(n)
    return LogPairs(x + noise[:, 0], y + noise[:, 1], own, shared, subject), truth
