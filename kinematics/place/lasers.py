"""How far the lasers agree: gain, phase and delay of each, estimated from the redundancy of all beams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from kinematics.faults.search import Diagnosis
from kinematics.joint.pack import Packed, pack
from kinematics.measurement import Measurement
from kinematics.place.channel_errors import UNLIKELY, ErrorEstimate, Lasers, estimate_errors, position_errors
from stapeskit.arrays import Array
from stapeskit.warnings import Notice


@dataclass(frozen=True)
class LaserAgreement:
    """Errors of the lasers, as far as the beams themselves leave them open.

    Attributes
    ----------
    estimate : ErrorEstimate
        Of gain, phase and delay; motion and stated errors of positions left free.
    across : mapping of str to ndarray, (p,)
        Covariance of what the estimate leaves with each error of a position, by its name.
    """

    estimate: ErrorEstimate
    across: Mapping[str, Array]

    @property
    def p_value(self) -> float:
        """Probability of lasers so far apart."""
        return self.estimate.p_value

    def notices(self) -> list[Notice]:
        """Return the warning that the lasers disagree by more than was stated."""
        if self.p_value > UNLIKELY:
            return []
        text = (
            f"the lasers disagree by more than stated: most the {self.estimate.largest()}. The motion is "
            "corrected by what the beams say together; calibrate the lasers, or state --gain-sd, --phase-sd, "
            "--delay-sd."
        )
        return [Notice("lasers_disagree", text)]


def laser_agreement(
    placed: Measurement, diagnoses: Mapping[int, Diagnosis], stated_sd: Mapping[str, float]
) -> LaserAgreement | None:
    """Estimate gain, phase and delay of every laser from all bodies together, without channels at fault.

    Parameters
    ----------
    diagnoses : mapping of int to Diagnosis
        By body.
    stated_sd : mapping of str to float
        By the names of `LASER_KINDS`: 1, rad and s; those that are exact are left out.

    Returns
    -------
    LaserAgreement or None
        None for one laser, or where all agree exactly.
    """
    lasers = Lasers.of(placed)
    errors = lasers.errors(stated_sd)
    if not errors:
        return None
    packs = {number: _sound_values(found) for number, found in diagnoses.items() if not _bends(found)}
    found = estimate_errors(placed, lasers, [*errors, *position_errors(placed)], packs)
    size = len(errors)
    own = ErrorEstimate(tuple(errors), found.values[:size], found.covariance[:size, :size], lasers)
    return LaserAgreement(own, dict(zip(found.names[size:], found.covariance[size:, :size], strict=True)))


def _bends(found: Diagnosis) -> bool:
    return bool(found.causes) or any(finding.kind == "flexible" for finding in found.findings)


def _sound_values(found: Diagnosis) -> Packed:
    """Return the values of a body without channels at fault; faults of whole lasers are left in."""
    readings = found.last.readings
    geometry = replace(readings.geometry, factor=np.ones((1, len(readings.noise_factor)), dtype=complex))
    packed = pack(replace(readings, geometry=geometry))
    return packed.scaled(np.full(len(packed.y), np.sqrt(found.last.noise.level)))
