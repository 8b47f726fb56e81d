"""A cohort of nine ears with a planted law, fitted once."""

import numpy as np
import pytest

from legacy.pipeline.cohort.api import Cohort
from legacy.pipeline.cohort.cohort_laws import cohort_laws
from legacy.stapeskit.results import extend_result
from tests.pipeline.cohort.simulated_ears import ear


@pytest.fixture(scope="session")
def ears():
    rng = np.random.default_rng(11)
    return [ear(k, rng) for k in range(9)]


@pytest.fixture(scope="session")
def studied(ears):
    return extend_result(Cohort, cohort_laws(ears))
