"""What the joint estimate of the geometry needs of the fits, and the errors that it leaves to all lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from legacy.kinematics.fit.beams import beam_set
from legacy.kinematics.fit.body_noise import fit_with_noise
from legacy.kinematics.fit.neglected_motion import extended_beams
from legacy.kinematics.fit.rigid_fit import LineFit
from legacy.kinematics.measurement import Measurement
from legacy.kinematics.registration.calibrate import Calibration, calibrate
from legacy.kinematics.registration.geometry_model import GeometryPriors
from legacy.kinematics.registration.shared_errors import fit_derivatives
from legacy.stapeskit.arrays import Array, ComplexArray
from legacy.stapeskit.spatial import dof_indices

# Up to here derivatives of all parameters are kept by name, beyond as so many patterns from so many lines.
_NAMED_BYTES = 2**27
_PATTERNS = 40
_SAMPLE_LINES = 200


def calibrate_with_noise(
    placed: Measurement, dof: tuple[str, ...], priors: GeometryPriors, robust: str
) -> Calibration:
    """Estimate the geometry, with the noise of the fits; twice where noise is known from residuals only.

    Parameters
    ----------
    placed : Measurement
        In the footplate frame.
    dof : tuple of str
        Those that are fitted; all others that the beams observe are left free too.

    Raises
    ------
    KinematicsError
        There is nothing to estimate, or beams that cannot observe the degrees of freedom.
    """
    free = [dof if len(dof) == 6 else extended_beams(body, dof).dof for body in placed.bodies]

    def weights_of(geometry: Measurement) -> dict[tuple[int, int], Array]:
        weights = {}
        for number, body in enumerate(geometry.bodies):
            beams = beam_set(body.body, body.positions_mm, body.directions, free[number])
            for run in range(len(geometry.runs)):
                weights[run, number] = fit_with_noise(geometry, run, body, beams, robust)[0].weights
        return weights

    stated = all(body.sd is not None and not body.relative for body in placed.bodies)
    geometry, calibration = placed, None
    for _ in range(1 if stated else 3):
        weights = weights_of(geometry)
        calibration = calibrate(placed, free, priors, weights)
        geometry = calibration.measurement
    if calibration is None:
        raise RuntimeError("a calibration takes at least one round")
    return calibration


def calibration_errors(
    calibration: Calibration, fits: Mapping[tuple[int, int], LineFit], shape: Sequence[int]
) -> tuple[tuple[str, ...], Array, ComplexArray]:
    """Return the parameters of a calibration as shared errors: names, covariance (p, p) and derivatives.

    Parameters
    ----------
    fits : mapping of (run, body) to LineFit
        With the calibrated geometry.
    shape : sequence of int
        (run, body, freq, m) of the motion.

    Notes
    -----
    Where the derivatives of all parameters would not fit into 128 MB, their joint covariance is rewritten as
    that of the 40 independent combinations that move the motion most.
    """
    size = len(calibration.names)
    if 16 * size * int(np.prod(shape)) <= _NAMED_BYTES:
        derivatives = np.zeros((size, *shape), dtype=complex)
        for (run, number), fit in fits.items():
            derivatives[:, run, number] = _group_derivatives(calibration, fit, number)
        return calibration.names, calibration.covariance, derivatives
    values, vectors = np.linalg.eigh(calibration.covariance)
    half = vectors * np.sqrt(np.maximum(values, 0.0))
    combined = half @ _strongest(calibration, fits, half)
    count = combined.shape[1]
    derivatives = np.zeros((count, *shape), dtype=complex)
    for (run, number), fit in fits.items():
        rows = np.einsum("kp,kcm->pcm", combined, _all_rows(calibration, fit, number))
        derivatives[:, run, number] = fit_derivatives(fit, rows)
    return tuple(f"calibration.{k + 1}" for k in range(count)), np.eye(count), derivatives


def _all_rows(calibration: Calibration, fit: LineFit, number: int) -> Array:
    """Return every parameter's change of all rows, (k, channel, m)."""
    rows = np.zeros(
        (len(calibration.names), len(calibration.measurement.bodies[number].points), len(fit.beams.dof))
    )
    for change in calibration.model.changes(number, calibration.values):
        rows[change.parameter, change.channels] = change.rows[:, dof_indices(fit.beams.dof)]
    return rows


def _group_derivatives(calibration: Calibration, fit: LineFit, number: int) -> ComplexArray:
    """Return d q / d parameter, (k, freq, m), group by group of equal channels."""
    derivatives = np.zeros((len(calibration.names), *fit.q.shape), dtype=complex)
    places = dof_indices(fit.beams.dof)
    channels = len(calibration.measurement.bodies[number].points)
    groups: dict[bytes, list[int]] = {}
    changes = calibration.model.changes(number, calibration.values)
    for place, change in enumerate(changes):
        groups.setdefault(change.channels.tobytes(), []).append(place)
    for members in groups.values():
        mask = np.zeros(channels, dtype=bool)
        mask[changes[members[0]].channels] = True
        rows = np.stack([changes[place].rows[:, places] for place in members])
        derivatives[[changes[place].parameter for place in members]] = fit_derivatives(fit, rows, mask)
    return derivatives


def _strongest(calibration: Calibration, fits: Mapping[tuple[int, int], LineFit], half: Array) -> Array:
    """Return the combinations (k, p) of unit-variance errors that move the motion most, against its size."""
    changes = []
    for (_run, number), fit in fits.items():
        rows = np.einsum("kp,kcm->pcm", half, _all_rows(calibration, fit, number))
        step = max(1, fit.q.shape[0] // _SAMPLE_LINES)
        part = np.stack([fit_derivatives(fit, row[None])[0, ::step] for row in rows])
        size = np.sqrt(np.nanmean(np.abs(fit.q) ** 2, axis=0))
        part = np.nan_to_num(part / np.where(size > 0.0, size, 1.0)).reshape(len(rows), -1)
        changes.append(np.hstack([part.real, part.imag]))
    _, vectors = np.linalg.eigh(sum(part @ part.T for part in changes))
    return np.asarray(vectors[:, ::-1][:, :_PATTERNS])
