"""Is the rigid fit as good as its bound, and are its errors honest? Monte Carlo, as markdown tables.

    python benchmarks/points_estimation.py            40 000 lines a case (half a minute)
    python benchmarks/points_estimation.py 4000

Nine points on footplate, crura and head with three beams each (half-cone 20 degrees), motion with resonances
of 100 nm and 35 urad; every line is one replicate. "Variance / bound" is the worst degree of freedom of the
mean squared error over the Cramer-Rao bound of known noise, in brackets their mean. "Coverage" is the share
of real and imaginary parts within 1.96 stated standard deviations. Seeds are fixed.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from legacy.kinematics.fit.beams import BeamSet, beam_set  # noqa: E402
from legacy.kinematics.fit.frf_ratio import per_reference  # noqa: E402
from legacy.kinematics.fit.rigid_fit import LineFit, fit_lines  # noqa: E402
from legacy.kinematics.measurement import BodyChannels  # noqa: E402
from legacy.kinematics.registration.placement import Placement  # noqa: E402
from legacy.kinematics.registration.shared_errors import pose_derivatives, position_errors  # noqa: E402
from legacy.kinematics.tidy.few_averages import steady_noise  # noqa: E402
from legacy.stapeskit.frames import RigidTransform  # noqa: E402
from legacy.stapeskit.records.motion import RigidMotion  # noqa: E402
from legacy.stapeskit.records.motion_files import line_covariance  # noqa: E402
from legacy.stapeskit.spatial import DOF_NAMES  # noqa: E402
from tests.kinematics.simulated import readings, smooth_motion, stapes_points, three_beams  # noqa: E402

LINES = 40000
LEVEL = 1e-9


@dataclass(frozen=True)
class Data:
    """Readings with known truth: positions (c, 3) mm, directions (c, 3), q (f, 6), clean and noise (c, f)."""

    positions_mm: np.ndarray
    directions: np.ndarray
    q: np.ndarray
    clean: np.ndarray
    sd: np.ndarray

    @property
    def beams(self) -> BeamSet:
        """All six degrees of freedom."""
        return beam_set("body", self.positions_mm, self.directions, DOF_NAMES)


def complex_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return noise whose real and imaginary parts have unit variance."""
    return rng.normal(size=(*shape, 2)).view(complex)[..., 0]


def made(
    seed: int, lines: int, *, spread: float = 0.0, per_line: bool = False, cone_deg: float = 20.0
) -> Data:
    """Return readings whose sd differ by up to 10^(+-spread) between channels, or between all values."""
    rng = np.random.default_rng([seed, 7])
    places = np.repeat(stapes_points(rng), 3, axis=0)
    beams = np.tile(three_beams(cone_deg), (9, 1))
    q = smooth_motion(rng, np.linspace(400.0, 5000.0, lines))
    shape = (27, lines) if per_line else (27, 1)
    sd = LEVEL * 10.0 ** rng.uniform(-spread, spread, shape) * np.ones((27, lines))
    return Data(places, beams, q, readings(places, beams, q), sd)


def bound(data: Data) -> np.ndarray:
    """Return the Cramer-Rao bound (freq, 6) of the variance of each real part."""
    rows = data.beams.rows
    scale = np.linalg.norm(rows, axis=0)
    unit = rows / scale
    grams = np.einsum("ca,cf,cb->fab", unit, data.sd**-2.0, unit, optimize=True)
    return np.diagonal(np.linalg.inv(grams), axis1=1, axis2=2) / scale**2


def efficiency(estimates: np.ndarray, data: Data) -> np.ndarray:
    """Return mean squared error over its bound, (6,)."""
    error = np.abs(estimates - data.q) ** 2 / 2.0
    return np.mean(error / bound(data), axis=0)


def coverage(fit: LineFit, truth: np.ndarray) -> float:
    """Return the share of parts of q within 1.96 of their stated standard deviations."""
    sd = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2) / 2.0)
    error = fit.q - truth
    return float(np.mean([np.abs(error.real) < 1.96 * sd, np.abs(error.imag) < 1.96 * sd]))


def alarms(fit: LineFit) -> float:
    """Return the share of lines whose chi2 is beyond its 95 % point."""
    from scipy.special import chdtrc

    return float(np.mean(chdtrc(fit.n_dof, fit.chi2) < 0.05))


@dataclass(frozen=True)
class Row:
    """One case: worst and mean variance over bound, coverage, chi2 alarms (NaN: does not apply)."""

    name: str
    ratio: np.ndarray
    coverage: float
    alarms: float = np.nan

    def cells(self) -> str:
        """Return a line of the table."""
        alarm = "" if np.isnan(self.alarms) else f"{100.0 * self.alarms:.1f} %"
        worst = self.ratio[np.argmax(np.abs(np.log(self.ratio)))]
        ratio = f"{worst:.3f} ({np.mean(self.ratio):.3f})"
        return f"| {self.name} | {ratio} | {100.0 * self.coverage:.1f} % | {alarm} |"


def judged(name: str, fit: LineFit, data: Data, tested: bool = True) -> Row:
    """Return the row of a fit."""
    return Row(name, efficiency(fit.q, data), coverage(fit, data.q), alarms(fit) if tested else np.nan)


def known_noise(lines: int) -> Iterator[Row]:
    """Noise that is known: equal, unequal between channels, unequal between all values."""
    for seed, (name, spread, per_line) in enumerate(
        (
            ("equal noise", 0.0, False),
            ("channels differ up to 10 x", 0.5, False),
            ("all values differ", 0.5, True),
        )
    ):
        data = made(seed, lines, spread=spread, per_line=per_line)
        value = data.clean + data.sd * complex_noise(np.random.default_rng([seed, 1]), data.sd.shape)
        yield judged(name, fit_lines(data.beams, value, data.sd), data)
        if spread:
            yield judged(
                f"{name}, weights ignored", fit_lines(data.beams, value, np.array(LEVEL)), data, False
            )
    data = made(9, lines, spread=0.5)
    value = data.clean + data.sd * complex_noise(np.random.default_rng([9, 1]), data.sd.shape)
    value[np.random.default_rng(9).random(value.shape) < 0.1] = np.nan
    kept = np.where(np.isfinite(value), data.sd, 1e3)
    missing = Data(data.positions_mm, data.directions, data.q, data.clean, kept)
    yield judged("10 % of single values missing", fit_lines(data.beams, value, data.sd), missing)


def averaged(lines: int, count: int, seed: int = 20) -> Iterator[Row]:
    """Noise known from ``count`` averages of each value alone, and smoothed over neighbouring lines."""
    data = made(seed, lines, spread=0.5)
    rng = np.random.default_rng([seed, count])
    course = np.exp(0.5 * np.sin(np.linspace(0.0, 8.0, lines)))
    data = Data(data.positions_mm, data.directions, data.q, data.clean, data.sd * course)
    value = data.clean + data.sd * complex_noise(rng, data.sd.shape)
    freedom = 2 * (count - 1)
    stated = data.sd * np.sqrt(rng.chisquare(freedom, data.sd.shape) / freedom)
    yield judged(f"sd from {count} averages, as they are", fit_lines(data.beams, value, stated), data)
    steady, _ = steady_noise(stated, count, "body", from_coherence=False)
    yield judged(f"sd from {count} averages, smoothed", fit_lines(data.beams, value, steady), data)


def with_outliers(lines: int, kind: str, share: float, seed: int = 30) -> Row:
    """A share of the values with thirtyfold noise."""
    data = made(seed, lines)
    rng = np.random.default_rng([seed, 1])
    noise = complex_noise(rng, data.sd.shape)
    noise[rng.random(noise.shape) < share] *= 30.0
    fit = fit_lines(data.beams, data.clean + data.sd * noise, data.sd, kind)
    name = "no outliers" if share == 0.0 else f"{100.0 * share:.0f} % outliers"
    return judged(f"{name}, {kind}", fit, data, False)


def cone(lines: int, half_deg: float) -> tuple[float, float]:
    """Return how much worse w_z is (rms) from x, y, z as if independent, and raw beams over their bound.

    Each point's three readings are turned into x, y, z first; these are then fitted with equal weights.
    """
    data = made(40, lines, cone_deg=half_deg)
    value = data.clean + data.sd * complex_noise(np.random.default_rng([40, 1]), data.sd.shape)
    raw = efficiency(fit_lines(data.beams, value, data.sd).q, data)
    solve = np.linalg.inv(three_beams(half_deg))
    axes = np.einsum("ij,pjf->pif", solve, value.reshape(9, 3, -1)).reshape(27, -1)
    beams = beam_set("body", data.positions_mm, np.tile(np.eye(3), (9, 1)), DOF_NAMES)
    plain = efficiency(fit_lines(beams, axes, np.array(LEVEL)).q, data)
    return float(np.sqrt(plain[5] / raw[5])), float(raw[5])


def reference_noise(lines: int, share: float, seed: int = 50) -> tuple[float, float]:
    """Return stated over true variance of y with s^2 q q^H for noise common to all channels, and without."""
    data = made(seed, lines)
    rng = np.random.default_rng([seed, 1])
    common = 1.0 + share * complex_noise(rng, (lines,))
    value = data.clean * common + data.sd * complex_noise(rng, data.sd.shape)
    fit = fit_lines(data.beams, value, data.sd)
    true = float(np.mean(np.abs(fit.q - data.q)[:, 1] ** 2))
    plain = fit.covariance[:, 1, 1]
    return float(np.mean(plain + 2.0 * share**2 * np.abs(fit.q[:, 1]) ** 2)) / true, float(
        np.mean(plain)
    ) / true


def ratio_coverage(lines: int, snr: float, seed: int = 60) -> tuple[float, float]:
    """Return true over stated variance (median over lines) and coverage of an FRF.

    The signal of its reference is ``snr`` standard deviations of the real part.
    """
    rng = np.random.default_rng([seed, int(10 * snr)])
    truth = np.array([0.7 + 0.4j, 1.0])
    sd = 1.0 / snr
    q = truth[None, :] + sd * complex_noise(rng, (lines, 2))
    covariance = np.broadcast_to(2.0 * sd**2 * np.eye(1), (1, 2, lines, 1, 1)).astype(complex)
    nothing = np.zeros((1, 2, lines))
    motion = RigidMotion(
        ("1",),
        ("a", "b"),
        ("y",),
        np.arange(1.0, lines + 1.0),
        q.T[None, :, :, None],
        covariance,
        nothing,
        nothing,
    )
    frf = per_reference(motion, "b:y")
    error = frf.q[0, 0, :, 0] - truth[0]
    variance = line_covariance(frf)[0, 0, :, 0, 0].real
    inside = np.abs(np.stack([error.real, error.imag])) < 1.96 * np.sqrt(variance / 2.0)
    return float(np.mean(np.abs(error) ** 2) / np.median(variance)), float(np.mean(inside))


def nees(replicates: int, stated: bool = True, seed: int = 70) -> float:
    """Return the mean normalised squared error of q at three lines jointly, over its dimension.

    Positions are wrong by 50 um each, the pose by 30 um and 0.3 degrees; both are stated, or neither.
    """
    rng = np.random.default_rng(seed)
    data = made(seed, 3)
    names = tuple(str(c // 3) for c in range(27))
    pose_sd = np.repeat([30e-6, np.radians(0.3)], 3)
    body = BodyChannels(
        "body", names, data.positions_mm, data.directions, data.clean[None], position_sd_mm=np.full(27, 0.05)
    )
    identity = RigidTransform(np.eye(4), "footplate", "vibrometer")
    placement = Placement(
        identity, tuple(f"registration.{n}" for n in DOF_NAMES), np.diag(pose_sd**2), np.eye(6)
    )
    total = 0.0
    for _ in range(replicates):
        moved = identity.perturbed(pose_sd * rng.normal(size=6))
        shifts = np.repeat(0.05 * rng.normal(size=(9, 3)), 3, axis=0)
        true_places = moved.points(data.positions_mm + shifts)
        value = readings(true_places, moved.vectors(data.directions), data.q)
        value = value + data.sd * complex_noise(rng, data.sd.shape)
        fit = fit_lines(data.beams, value, data.sd)
        shared = position_errors({(0, 0): fit}, [body])
        slopes = np.concatenate([pose_derivatives(fit, body, placement), shared.derivatives[:, 0, 0]])
        variances = np.concatenate([pose_sd**2, shared.variances])
        flat = slopes.reshape(len(slopes), -1)
        parts = np.hstack([flat.real, flat.imag])
        noise = np.zeros((18, 18))
        for line in range(3):
            noise[6 * line : 6 * line + 6, 6 * line : 6 * line + 6] = fit.covariance[line] / 2.0
        covariance = np.kron(np.eye(2), noise)
        if stated:
            covariance = covariance + (parts.T * variances) @ parts
        error = (fit.q - data.q).ravel()
        error = np.concatenate([error.real, error.imag])
        scale = np.sqrt(np.diag(covariance))
        white = np.linalg.solve(covariance / np.outer(scale, scale), error / scale)
        total += float(white @ (error / scale)) / len(error)
    return total / replicates


def main(lines: int) -> None:
    """Print all tables."""
    head = "| case | variance / bound | coverage of 95 % | chi2 alarms at 5 % |\n|-|-|-|-|"
    print(f"{lines} lines a case\n\n{head}")
    for row in known_noise(lines):
        print(row.cells())
    for count in (3, 5, 10, 30):
        for row in averaged(lines, count):
            print(row.cells())
    for share in (0.0, 0.05):
        for kind in ("none", "huber", "t4"):
            print(with_outliers(lines, kind, share).cells())
    print(
        "\n| three lasers, half-cone | error in w_z of x, y, z as if independent / raw beams | raw / bound |"
    )
    print("|-|-|-|")
    for half in (10.0, 20.0, 30.0):
        loss, raw = cone(lines, half)
        print(f"| {half:.0f} degrees | {loss:.2f} | {raw:.3f} |")
    print("\n| noise common to all channels | stated / true variance of y | without s^2 q q^H |\n|-|-|-|")
    for share in (0.01, 0.05):
        with_it, without = reference_noise(lines, share)
        print(f"| {100.0 * share:.0f} % | {with_it:.3f} | {without:.3f} |")
    print(
        "\n| SNR of the reference | true / stated (median) variance of the FRF | coverage of 95 % |\n|-|-|-|"
    )
    for snr in (100.0, 30.0, 10.0, 5.0, 3.0):
        ratio, covered = ratio_coverage(10 * lines, snr)
        print(f"| {snr:.0f} | {ratio:.3f} | {100.0 * covered:.1f} % |")
    count = max(lines // 20, 100)
    print(f"\nNEES of q at three lines jointly, {count} geometries with errors of positions and pose:")
    print(f"stated as priors {nees(count):.3f}, channel noise alone {nees(count, stated=False):.1f}.")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else LINES)
