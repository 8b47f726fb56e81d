"""What is reported of the agreement of the lasers, and which channels may say something about it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from legacy.kinematics.faults.catalogue import KINDS, OF_MANY
from legacy.kinematics.faults.diagnosis import Diagnosis
from legacy.kinematics.faults.laser_scatter import OF_LASERS
from legacy.kinematics.measurement import direction_name
from legacy.kinematics.registration.laser_errors import LaserErrors
from legacy.kinematics.registration.laser_estimate import UNLIKELY
from legacy.kinematics.registration.prior_errors import shown
from legacy.stapeskit.option_names import named
from legacy.stapeskit.warnings import Notice

# Kinds of fault that are an error of gain, phase or delay.
_LASER_KINDS = {name for name, kind in KINDS.items() if set(kind.tangents) <= set(OF_LASERS)}


def channels_at_fault(diagnoses: Mapping[tuple[int, int], Diagnosis]) -> dict[tuple[int, int], list[int]]:
    """Return the faulty channels by run and body, without the bodies that are faulty as a whole.

    A gain, phase or delay that all channels of a laser share does not count: it is estimated for the laser.
    """
    at_fault: dict[tuple[int, int], list[int]] = {}
    for key, diagnosis in diagnoses.items():
        channels: set[int] = set()
        for finding in diagnosis.findings:
            if finding.owner in ("laser", "lasers") and finding.kind in _LASER_KINDS:
                continue
            if finding.owner in OF_MANY or finding.code:
                break
            channels.update(finding.channels)
        else:
            at_fault[key] = sorted(channels)
    return at_fault


def laser_notices(lasers: LaserErrors) -> list[Notice]:
    """Return the warning that the lasers disagree by more than was stated."""
    if lasers.estimate.p_value > UNLIKELY:
        return []
    prior = lasers.prior_sd
    worst = int(np.argmax(np.abs(lasers.estimate.values) / prior))
    kind, _, number = lasers.names[worst].partition(".")
    name, factor, unit = shown(kind)
    beams = direction_name(lasers.directions[int(number) - 1])
    text = (
        f"the lasers disagree by more than stated: most the {name} of the laser along ({beams}), by "
        f"{lasers.estimate.values[worst] * factor:+.3g} +- {lasers.sd[worst] * factor:.2g} {unit} (stated sd "
        f"{prior[worst] * factor:.2g} {unit}). The motion is corrected by what the beams say together; "
        f"calibrate the lasers, or state {named('gain_sd')}, {named('phase_sd')}, {named('delay_sd')}."
    )
    return [Notice("lasers_disagree", text)]


def laser_table(lasers: LaserErrors) -> list[tuple[str, float, float, float, str]]:
    """Return name, estimate, sd, stated sd and unit of every parameter, in shown units."""
    rows = []
    for place, full in enumerate(lasers.names):
        kind, _, number = full.partition(".")
        name, factor, unit = shown(kind)
        beams = direction_name(lasers.directions[int(number) - 1])
        sizes = (lasers.estimate.values[place], lasers.sd[place], lasers.prior_sd[place])
        value, sd, stated = (float(size) * factor for size in sizes)
        rows.append((f"{name} of laser {number} ({beams})", value, sd, stated, unit))
    return rows
