"""Which faults say that a body cannot tell how the lasers agree."""

from __future__ import annotations

import numpy as np
import pytest

from legacy.kinematics.faults.catalogue import Fault
from legacy.kinematics.faults.diagnosis import Diagnosis
from legacy.kinematics.faults.findings import Finding
from legacy.kinematics.faults.flexible_body import no_structure
from legacy.kinematics.registration.laser_notices import channels_at_fault


def diagnosis(*findings):
    """Return a diagnosis of six channels."""
    return Diagnosis(findings, np.ones(6), 1.0, no_structure(6), np.full(6, 10))


def finding(kind, owner, channels):
    """Return a finding of the catalogue."""
    return Finding(kind, channels, fault=Fault(kind, owner, channels))


@pytest.mark.parametrize("kind", ["gain", "phase", "delay", "phase_offset"])
def test_what_is_estimated_for_a_laser_is_no_fault_of_its_channels(kind):
    both = diagnosis(finding(kind, "laser", [0, 2, 4]), finding("gain", "channel", [1]))
    assert channels_at_fault({(0, 0): both}) == {(0, 0): [1]}


@pytest.mark.parametrize(("kind", "owner"), [("drift", "laser"), ("direction", "laser"), ("axes", "body")])
def test_a_body_with_another_fault_of_many_channels_says_nothing(kind, owner):
    assert channels_at_fault({(0, 0): diagnosis(finding(kind, owner, [0, 2, 4]))}) == {}
