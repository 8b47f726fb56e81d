"""The rigid fit is as good as its Cramer-Rao bound, and its stated errors hold: every line is one replicate.

Nine points on footplate, crura and head with three beams each (half-cone 20 degrees), motion with
resonances of 100 nm and 35 urad. "Variance / bound" is the worst degree of freedom of the mean squared
error over the bound of known noise, in brackets their mean. "Coverage" is the share of real and imaginary
parts within 1.96 stated standard deviations. The second table has noise as files state it: from coherence of
few averages, none at all, and motion per unit of a noisy reference, whose noise is common to all of them.

    python -m benchmarks.points_estimation --lines 40000
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks._table import arguments, print_table
from kinematics.fit.beams import BeamSet, beam_set
from kinematics.fit.few_averages import with_steady_noise
from kinematics.fit.noise import fit_with_noise
from kinematics.fit.reference import per_reference
from kinematics.fit.rigid_fit import LineFit, fit_lines
from kinematics.joint.expected import stated_errors
from kinematics.measurement import BodyChannels, Measurement
from kinematics.place.errors import estimate_errors
from kinematics.place.placement import Placement
from kinematics.place.shared_errors import shared_errors
from simulate import resonant_motion, scattered_points
from simulate.vibrometer import laser_directions
from stapeskit.arrays import Array, ComplexArray
from stapeskit.frames import RigidTransform, rotation_from_vector
from stapeskit.records.rigid_motion import RigidMotion
from stapeskit.spatial import DOF_NAMES, point_rows

LEVEL = 1e-9
POSITION_SD_M, POSE_SD = 50e-6, np.repeat([30e-6, np.radians(0.3)], 3)


@dataclass(frozen=True)
class Readings:
    """Readings with a known truth: places and beams (27, 3), q (L, 6), clean and sd (27, L), displacement."""

    places_mm: Array
    beams: Array
    q: ComplexArray
    clean: ComplexArray
    sd: Array

    @property
    def beam_set(self) -> BeamSet:
        """All six degrees of freedom."""
        return beam_set("body", self.places_mm * 1e-3, self.beams, DOF_NAMES)

    def noisy(self, *seed: int) -> ComplexArray:
        """Return the readings with noise."""
        return self.clean + self.sd * unit_noise(np.random.default_rng(seed), self.sd.shape)

    def fit(self, value: ComplexArray, sd: Array, robust: str = "none") -> LineFit:
        """Fit the motion."""
        return fit_lines(self.beam_set, value, sd, np.ones(value.shape[1], dtype=complex), robust)

    def efficiency(self, estimates: ComplexArray) -> Array:
        """Return the mean squared error over its Cramer-Rao bound, (6,)."""
        rows = self.beam_set.rows
        scale = np.linalg.norm(rows, axis=0)
        unit = rows / scale
        information = np.einsum("ca,cf,cb->fab", unit, self.sd**-2.0, unit, optimize=True)
        bound = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2) / scale**2
        return np.asarray(np.mean(np.abs(estimates - self.q) ** 2 / 2.0 / bound, axis=0))


def unit_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> ComplexArray:
    """Return noise whose real and imaginary parts have unit variance."""
    return np.asarray(rng.standard_normal((*shape, 2)) @ np.array([1.0, 1j]))


def readings(
    seed: int, lines: int, spread: float = 0.0, per_value: bool = False, cone: float = 20.0
) -> Readings:
    """Return readings whose sd differ by up to 10^(+-spread) between channels, or between all values."""
    rng = np.random.default_rng([seed, 7])
    places = np.repeat(scattered_points(rng, 9), 3, axis=0)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # the optical axis is y
    beams = np.tile(laser_directions(3, cone) @ turn.T, (9, 1))
    q = resonant_motion(rng, np.linspace(400.0, 5000.0, lines))
    sd = LEVEL * 10.0 ** rng.uniform(-spread, spread, (27, lines if per_value else 1)) * np.ones((27, lines))
    return Readings(places, beams, q, point_rows(places * 1e-3, beams) @ q.T, sd)


def row(name: str, fit: LineFit, data: Readings, tested: bool = True) -> list[object]:
    """Return the row of a fit."""
    from scipy.special import chdtrc

    ratio = data.efficiency(fit.q)
    sd = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2) / 2.0)
    error = fit.q - data.q
    inside = np.abs(np.stack([error.real, error.imag])) < 1.96 * sd
    alarms = f"{100 * np.mean(chdtrc(fit.n_dof, fit.chi2) < 0.05):.1f} %" if tested else ""
    worst = ratio[np.argmax(np.abs(np.log(ratio)))]
    return [name, f"{worst:.3f} ({np.mean(ratio):.3f})", f"{100 * np.mean(inside):.1f} %", alarms]


def known_noise(lines: int) -> Iterator[list[object]]:
    """Yield noise that is known: equal, unequal between channels or values; gaps; outliers."""
    kinds = {
        "equal noise": (0.0, False),
        "channels differ up to 10 x": (0.5, False),
        "all values differ": (0.5, True),
    }
    for seed, (name, (spread, per_value)) in enumerate(kinds.items()):
        data = readings(seed, lines, spread, per_value)
        value = data.noisy(seed, 1)
        yield row(name, data.fit(value, data.sd), data)
        if spread:
            plain = data.fit(value, np.full(data.sd.shape, LEVEL))
            yield row(f"{name}, weights ignored", plain, data, False)
    data = readings(9, lines, 0.5)
    value = data.noisy(9, 1)
    value[np.random.default_rng(9).random(value.shape) < 0.1] = np.nan
    kept = Readings(
        data.places_mm, data.beams, data.q, data.clean, np.where(np.isfinite(value), data.sd, 1e3)
    )
    yield row("10 % of single values missing", data.fit(value, data.sd), kept)
    for share in (0.0, 0.05):
        for robust in ("none", "huber", "t4"):
            data, rng = readings(30, lines), np.random.default_rng([30, 1])
            noise = unit_noise(rng, data.sd.shape)
            noise[rng.random(noise.shape) < share] *= 30.0
            name = f"{100 * share:.0f} % outliers, {robust}" if share else f"no outliers, {robust}"
            yield row(name, data.fit(data.clean + data.sd * noise, data.sd, robust), data, False)


def found_noise(lines: int) -> Iterator[list[object]]:
    """Yield noise that files do not know exactly: sd from averages, and none stated."""
    data, rng = readings(40, lines, 0.5), np.random.default_rng([40, 1])
    value = data.noisy(40, 1)
    points = {"points": tuple(str(channel // 3) for channel in range(27)), "directions": data.beams}
    for averages in (200, 50, 16, 4):
        square = rng.chisquare(2 * (averages - 1), data.sd.shape) / (2 * averages)
        stated = {"sd": (data.sd * np.sqrt(square))[None], "averages": np.full(27, float(averages))}
        body = BodyChannels("body", positions_m=data.places_mm * 1e-3, value=value[None], **points, **stated)
        sd = with_steady_noise(body).sd
        yield row(f"coherence of {averages} averages", data.fit(value, sd[0]), data)
    body = BodyChannels("body", positions_m=data.places_mm * 1e-3, value=value[None], **points)
    placed = Measurement("footplate", ("1",), np.linspace(400.0, 5000.0, lines), (body,), "displacement")
    yield row("none stated", fit_with_noise(placed, 0, body, data.beam_set)[0], data, False)


def per_unit(lines: int) -> Iterator[list[object]]:
    """Yield how often intervals of motion per unit of a reference hold, by size of the reference."""
    data = readings(50, lines)
    fit = data.fit(data.noisy(50, 1), data.sd)
    rng, freq_hz = np.random.default_rng([50, 2]), np.linspace(400.0, 5000.0, lines)
    for ratio in (100.0, 30.0, 10.0, 3.0):
        shape = (1, 2, lines)
        true = np.zeros((1, 2, lines, 6), dtype=complex)
        true[0, 0], true[0, 1, :, 1] = data.q, 1e-7
        covariance = np.stack([fit.covariance, np.zeros_like(fit.covariance)])[None].astype(complex)
        sd = 1e-7 / ratio
        covariance[0, 1, :, 1, 1] = 2.0 * sd**2
        seen = np.stack([fit.q, true[0, 1]])[None]
        seen[0, 1, :, 1] += sd * unit_noise(rng, (lines,))
        sums = np.ones(shape)
        motion = RigidMotion(("1",), ("body", "base"), DOF_NAMES, freq_hz, seen, covariance, sums, sums)
        found = per_reference(motion, "base:y")
        off = (found.q[0, 0] - data.q / 1e-7) / found.standard_deviation[0, 0]
        inside = [float(np.mean(np.abs(part) < 1.96)) for part in (off.real, off.imag)]
        yield [f"{ratio:g}", f"{100.0 * np.mean(inside):.1f} %"]


def squared_distance(replicates: int, stated: bool) -> float:
    """Return the mean normalised squared error of q at three lines jointly, over its dimension.

    Positions are off by 50 um each, the pose by 30 um and 0.3 degrees; both are stated, or neither.
    """
    rng, data, total = np.random.default_rng(70), readings(70, 3), 0.0
    names = tuple(str(channel // 3) for channel in range(27))
    freq_hz = np.linspace(400.0, 5000.0, 3)
    placement = Placement(
        RigidTransform(np.eye(4), "footplate", "vibrometer"),
        tuple(f"registration.{name}" for name in DOF_NAMES), np.diag(POSE_SD**2), np.eye(6),
    )  # fmt: skip
    for _ in range(replicates):
        error = POSE_SD * rng.standard_normal(6)
        turn = rotation_from_vector(error[3:])
        places = data.places_mm * 1e-3 + np.repeat(POSITION_SD_M * rng.standard_normal((9, 3)), 3, axis=0)
        rows = point_rows(places @ turn.T + error[:3], data.beams @ turn.T)
        value = rows @ data.q.T + data.sd * unit_noise(rng, data.sd.shape)
        parts = {
            "points": tuple(names), "positions_m": data.places_mm * 1e-3, "directions": data.beams,
            "value": value[None], "sd": data.sd[None], "position_sd_m": np.full(len(names), POSITION_SD_M),
        }  # fmt: skip
        placed = Measurement("footplate", ("1",), freq_hz, (BodyChannels("body", **parts),), "displacement")
        fit = data.fit(value, data.sd)
        covariance = np.zeros((18, 18))
        for line in range(3):
            covariance[6 * line : 6 * line + 6, 6 * line : 6 * line + 6] = fit.covariance[line] / 2.0
        covariance = np.kron(np.eye(2), covariance)
        if stated:
            positions = estimate_errors(placed, stated_errors(placed.bodies, {}), {})
            shared = shared_errors(placed, {(0, 0): fit}, placement, positions)
            assert shared is not None
            slopes = shared.derivatives[:, 0, 0].reshape(len(shared.names), -1)
            both = np.hstack([slopes.real, slopes.imag])
            covariance = covariance + both.T @ shared.covariance @ both
        off = (fit.q - data.q).ravel()
        off = np.concatenate([off.real, off.imag])
        scale = np.sqrt(np.diag(covariance))
        total += float(off / scale @ np.linalg.solve(covariance / np.outer(scale, scale), off / scale)) / 36
    return total / replicates


if __name__ == "__main__":
    given = arguments(__doc__, lines=2000, geometries=100)
    print(f"{given.lines} lines a case; worst degree of freedom (mean).\n")
    print_table(("case", "variance/bound", "95 % holds", "chi2 alarms at 5 %"), known_noise(given.lines))
    head = ("noise as stated", "variance/bound", "95 % holds", "chi2 alarms at 5 %")
    print_table(head, found_noise(given.lines))
    print_table(("reference over its sd", "95 % of ratios hold"), per_unit(given.lines))
    distances = [squared_distance(given.geometries, stated) for stated in (True, False)]
    print(f"Squared distance of q at three lines jointly, over its dimension, {given.geometries} geometries:")
    print(f"stated as priors {distances[0]:.3f}, channel noise alone {distances[1]:.1f}.")
