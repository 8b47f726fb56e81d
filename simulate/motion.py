"""The rigid motion of a recording by plain least squares, with its covariance and its shared errors.

What a fit of K and D starts from, without the room that estimates motion: no search for faults, no files. It
maps the reported places and directions by the true pose of the vibrometer, and draws an error of that pose.
"""

from __future__ import annotations

import numpy as np

from simulate.vibrometer import Recording
from stapeskit.arrays import Array, ComplexArray
from stapeskit.frames import RigidTransform, cross_matrix, rotation_from_vector
from stapeskit.records.rigid_motion import RigidMotion, SharedErrors
from stapeskit.spatial import DOF_NAMES, dof_indices, point_rows, shifted_point_rows, twist_transfer


class _BodyFit:
    """Weighted least squares of one body: q (R, L, n) and its covariance; missing values have no weight."""

    def __init__(self, recording: Recording, body: str, dof: tuple[str, ...]) -> None:
        own = recording.channels(body)
        back = RigidTransform.identity("footplate", "footplate")
        if recording.frame != "footplate":
            back = recording.vibrometer_from_footplate.inverse()
        self.points = np.array([recording.point[channel] for channel in own])
        self.used = dof_indices(dof)
        self.beams = back.vectors(recording.direction[own])
        self.rows = point_rows(back.points(recording.position_mm[own]) * 1e-3, self.beams)[:, self.used]
        omega = 2.0 * np.pi * recording.freq_hz
        values = recording.velocity_m_s[:, own] / (1j * omega)
        missing = np.isnan(values)
        self.weight = np.where(missing, 0.0, (recording.sd_m_s[:, own] / omega) ** -2.0)
        values = np.where(missing, 0.0, values)
        normal = np.einsum("ci,rcl,cj->rlij", self.rows, self.weight, self.rows)
        self.normal_inverse = np.linalg.inv(normal)
        right = np.einsum("ci,rcl,rcl->rli", self.rows, self.weight, values)
        self.q = np.einsum("rlij,rlj->rli", self.normal_inverse, right)
        self.residual = values - np.einsum("ci,rli->rcl", self.rows, self.q)

    def slope_of_place(self, point: str, axis: int) -> ComplexArray:
        """Return the derivative (R, L, n) of q by the reported place of a point along an axis, per m.

        dq = N^-1 (dA^T W r - A^T W dA q), from the normal equations N q = A^T W y.
        """
        own = self.points == point
        step = shifted_point_rows(self.beams, np.eye(3)[axis])[:, self.used] * own[:, None]
        seen = np.einsum("ci,rli->rcl", step, self.q)
        change = np.einsum("ci,rcl,rcl->rli", step, self.weight, self.residual)
        change -= np.einsum("ci,rcl,rcl->rli", self.rows, self.weight, seen)
        return np.asarray(np.einsum("rlij,rlj->rli", self.normal_inverse, change))


def motion_of(
    recording: Recording,
    *,
    dof: tuple[str, ...] = DOF_NAMES,
    registration_sd: tuple[float, float] = (0.0, 0.0),
    seed: int = 1,
) -> RigidMotion:
    """Estimate the motion of all bodies about the footplate centre in footplate axes.

    ``shared`` holds ``position.BODY_POINT_AXIS`` where the recording states an sd of positions, and
    ``registration.DOF``.

    Parameters
    ----------
    dof : tuple of str
        Degrees of freedom that are solved for; the others are taken to rest.
    registration_sd : (float, float)
        Standard deviation per axis with which the pose of the footplate is known, m and rad; an error of it
        is drawn by ``seed``. With (0, 0) it is exact and no shared error.
    """
    bodies = tuple(dict.fromkeys(recording.body))
    fits = [_BodyFit(recording, body, dof) for body in bodies]
    used = np.ix_(dof_indices(dof), dof_indices(dof))
    spread = np.repeat(np.asarray(registration_sd, dtype=float), 3)
    error = spread * np.random.default_rng([seed, 47]).standard_normal(6)
    frame = twist_transfer(rotation_from_vector(error[3:]).T, error[:3])[used]
    q = np.stack([fit.q @ frame.T for fit in fits], axis=1)
    covariance = np.stack([frame @ fit.normal_inverse @ frame.T * 2.0 for fit in fits], axis=1)
    chi2 = np.stack([np.sum(np.abs(fit.residual) ** 2 * fit.weight, axis=1) for fit in fits], axis=1)
    count = np.stack([np.count_nonzero(fit.weight, axis=1) for fit in fits], axis=1)
    names, sds, slopes, maps = list[str](), list[float](), list[ComplexArray](), list[ComplexArray]()
    for place, (body, fit) in enumerate(zip(bodies, fits, strict=True)):
        for point in dict.fromkeys(fit.points.tolist()) if recording.position_sd_mm else ():
            for axis in range(3):
                change = np.zeros(q.shape, dtype=complex)
                change[:, place] = fit.slope_of_place(point, axis) @ frame.T
                names.append(f"position.{body}_{point}_{'xyz'[axis]}")
                sds.append(recording.position_sd_mm * 1e-3)
                slopes.append(change)
                maps.append(np.full((len(bodies), 6, 6), np.nan, dtype=complex))
    for place, name in enumerate(DOF_NAMES):
        if not spread[place]:
            continue
        step = _frame_slope(place)
        names.append(f"registration.{name}")
        sds.append(spread[place])
        slopes.append(np.asarray(q @ step[used].T))
        maps.append(np.broadcast_to(step + 0j, (len(bodies), 6, 6)))
    shared = None
    if names:
        powers = np.zeros(len(names), dtype=int)
        shared = SharedErrors(
            tuple(names), np.diag(np.square(sds)), np.array(slopes), maps=np.array(maps), powers=powers
        )
    return RigidMotion(
        runs=recording.runs,
        bodies=bodies,
        dof=dof,
        freq_hz=recording.freq_hz,
        q=q,
        covariance=covariance.astype(complex),
        chi2=chi2,
        n_dof=2 * (count - len(dof)),
        shared=shared,
    )


def _frame_slope(place: int) -> Array:
    """Return the derivative (6, 6) of the map of the motion by a displacement of its frame."""
    unit = np.eye(6)[place]
    step = np.zeros((6, 6))
    step[:3, :3] = step[3:, 3:] = -cross_matrix(unit[3:])
    step[:3, 3:] = -cross_matrix(unit[:3])
    return step
