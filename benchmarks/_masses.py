"""Simulated scans through ct2mass, and its mass properties and frames against the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ct_inertia.frames.gap import WindowGap
from simulate import Ear, MassProperties, Scan, Truth, simulate_truth, write_scan
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.frames import RigidTransform
from stapeskit.records.mass_matrix import MassMatrix
from stapeskit.records.mass_record import MassRecord
from stapeskit.registration import displacement
from stapeskit.spatial import central_tensor

UPPER = np.triu_indices(6)
EXACT_DENSITY = 1e-9
"""Relative standard deviation that leaves the density exact."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """What ct2mass made of a simulated scan; ``record`` is None where it refuses."""

    truth: Truth
    record: MassRecord | None
    seconds: float
    refusal: str = ""
    gap: WindowGap | None = None

    @property
    def matrix(self) -> MassMatrix:
        """The mass matrix about the measured footplate centre."""
        assert self.record is not None
        return self.record.mass_matrix

    @property
    def codes(self) -> list[str]:
        """Codes of the warnings."""
        return [] if self.record is None else sorted({notice.code for notice in self.record.notices})

    @property
    def volume_error(self) -> float:
        """Relative error of mass, the density being exact."""
        return float(self.matrix.parameters[0] / self.truth.parameters_si[0] - 1.0)

    @property
    def volume_sd(self) -> float:
        """Stated relative standard deviation of it."""
        return float(np.sqrt(self.matrix.covariance[0, 0]) / self.matrix.parameters[0])

    @property
    def body_in_scan(self) -> MassProperties:
        """Mass, centre of mass and inertia about it, in scan axes."""
        assert self.record is not None
        mass, tensor = central_tensor(self.matrix.parameters)
        pose = self.record.scan_from_footplate
        centre = pose.points(self.matrix.parameters[1:4] / mass * 1e3)
        inertia = pose.rotation @ tensor @ pose.rotation.T
        return MassProperties(mass_kg=mass, centre_of_mass_mm=centre, inertia_about_com_kg_m2=inertia)

    @property
    def frame_deviation(self) -> Array:
        """Displacement (6,) of the footplate frame in its true axes, m and rad."""
        assert self.record is not None
        return displacement(self.truth.scan_from_footplate, self.record.scan_from_footplate)

    @property
    def frame_sd(self) -> Array:
        """Its stated standard deviations."""
        assert self.record is not None
        return np.asarray(np.sqrt(np.diag(self.record.footplate_covariance)))

    @property
    def matrix_deviations(self) -> Array:
        """Errors of M (21,), upper triangle, over their stated sd; NaN where an entry is exact."""
        off = (self.matrix.matrix - self.truth.mass_matrix_si)[UPPER]
        sd = self.matrix.standard_deviation[UPPER]
        return np.divide(off, sd, out=np.full(off.shape, np.nan), where=sd > 0.0)


def matrix_in_frame(body: MassProperties, scan_from_frame: RigidTransform) -> Array:
    """Return the mass matrix (6, 6) about the origin of a frame, in its axes, of a body in scan axes."""
    back = scan_from_frame.inverse()
    turned = back.rotation @ body.inertia_about_com_kg_m2 @ back.rotation.T
    centre = back.points(body.centre_of_mass_mm)
    own = MassProperties(mass_kg=body.mass_kg, centre_of_mass_mm=centre, inertia_about_com_kg_m2=turned)
    return own.matrix()


def shares(matrix: Array, true: Array) -> Array:
    """Return errors over sqrt(Mii Mjj), (6, 6)."""
    root = np.sqrt(np.diag(true))
    return np.asarray((matrix - true) / np.outer(root, root))


def options_of(truth: Truth) -> dict[str, Any]:
    """Return what the experimenter states: the exact density, the side and where anterior is."""
    density = truth.ear.density_kg_m3
    return {
        "density_kg_m3": (density, EXACT_DENSITY * density),
        "anterior": tuple(float(part) for part in truth.scan_from_footplate.rotation[:, 0]),
        "side": truth.ear.side,
    }


def measure(ear: Ear, scan: Scan, folder: Path, **options: Any) -> Measured:
    """Write the scan of an ear, run ct2mass on the file and remove it."""
    from ct_inertia.api import ct2mass

    truth = simulate_truth(ear, scan)
    path = write_scan(folder, truth.placed, scan)
    started = time.process_time()
    try:
        result = ct2mass(path, **{**options_of(truth), **options})
    except StapeskitError as error:
        return Measured(
            truth=truth, record=None, seconds=time.process_time() - started, refusal=f"{error}"[:90]
        )
    finally:
        path.unlink()
    seconds = time.process_time() - started
    return Measured(truth=truth, record=result.record, seconds=seconds, gap=result.gap)
