"""A stapes that moves as a piston and rocks, and not in the plane: the intervals of K and D hold."""

import numpy as np

import legacy.stapeskit as sk
from tests.fitting.cases import K

COUPLED = [6.142e-6, -3.679e-6, -6.756e-12]  # yalpha, ygamma, alphagamma
D = np.diag([0.02289, 3.015e-8, 5.646e-8])
D[[0, 0, 1], [1, 2, 2]] = D[[1, 2, 2], [0, 0, 1]] = COUPLED
CENTRE = np.array([0.05e-3, 1.2e-3, -0.08e-3])
TENSOR = np.array([[6.0e-12, -0.3e-12, 0.1e-12], [-0.3e-12, 3.5e-12, 0.2e-12], [0.1e-12, 0.2e-12, 7.5e-12]])
MASS_KG = 3.2e-6


def mass_matrix():
    """Return the mass matrix about the footplate centre (6, 6), SI."""
    x, y, z = CENTRE
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    upper, coupled = MASS_KG * np.eye(3), -MASS_KG * cross
    return np.block([[upper, coupled], [coupled.T, TENSOR - MASS_KG * cross @ cross]])


MASS = mass_matrix()
POINTS_MM = {
    "stapes": [(1.2, 0.15, 0), (-1.2, 0.15, 0.1), (0.5, 0.15, 0.5), (0.1, 3.2, 0.2), (-0.4, 0.15, -0.55),
               (0.2, 1.6, -0.1)],
    "base": [(2.5, 0.3, 0), (-2.5, 0.4, 0.2), (0, 0.3, 2), (0.3, 1.3, -2), (1.5, -0.4, 1.5)],
}  # fmt: skip
BEAMS = np.array([(0.15, 1, 0.2), (0.5, 1, -0.3), (-0.45, 1, -0.15)])
BEAMS /= np.linalg.norm(BEAMS, axis=1)[:, None]
NOISE = 2e-6  # m/s


def motion(freq_hz):
    """Return velocities of both bodies (line, 6), m/s and rad/s."""
    places = [1, 3, 5]
    omega = 2.0 * np.pi * freq_hz
    phase = 6e-4 * np.exp(-0.3j - 1e-5j * omega)
    base, stapes = np.zeros((2, len(omega), 6), dtype=complex)
    base[:, places] = np.stack([phase, 40.0 * phase * np.exp(0.4j), -30.0 * phase], axis=1)
    stiffness = K + 1j * omega[:, None, None] * D
    inertia = omega[:, None, None] ** 2 * MASS[np.ix_(places, places)]
    force = np.einsum("lij,lj->li", stiffness, base[:, places])
    stapes[:, places] = np.linalg.solve(stiffness - inertia, force[..., None])[..., 0]
    return {"stapes": stapes, "base": base}


def table(seed, scatter=0.0, lines=120):
    """Return a vibrometer table; ``scatter`` times 1 %, 0.5 degrees and 1 us is the sd of the lasers."""
    rng, lasers = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    freq_hz = np.linspace(400.0, 5000.0, lines)
    gain, phase, delay = scatter * lasers.standard_normal((3, len(BEAMS), 1))
    factor = (1.0 + 0.01 * gain) * np.exp(
        1j * (np.radians(0.5 * phase) - 2.0 * np.pi * freq_hz * 1e-6 * delay)
    )
    rows = ["body,point,x_mm,y_mm,z_mm,dir_x,dir_y,dir_z,freq_hz,re_m_s,im_m_s,sd_m_s"]
    for body, moved in motion(freq_hz).items():
        for point, place in enumerate(POINTS_MM[body]):
            velocity = moved[:, :3] + np.cross(moved[:, 3:], 1e-3 * np.array(place))
            for beam, own in zip(BEAMS, factor, strict=True):
                noise = NOISE * (rng.standard_normal((lines, 2)) @ [1.0, 1j])
                where = ",".join(f"{v:.12g}" for v in (*place, *beam))
                rows += [
                    f"{body},{point},{where},{f:.9g},{v.real:.9g},{v.imag:.9g},{NOISE}"
                    for f, v in zip(freq_hz, own * (velocity @ beam) + noise, strict=True)
                ]
    return "\n".join(rows) + "\n"


def fitted(path, **options):
    return sk.dof2kd(sk.points2dof(path), mass=MASS, bands=0, **options)


def deviations(path, seed, scatter=0.0, lines=120):
    """Return how many of their sd the entries of K and D (12,) lie off."""
    path.write_text(table(seed, scatter, lines), encoding="utf-8")
    fit = fitted(path)
    off = [matrix[np.triu_indices(3)] for matrix in (fit.stiffness - K, fit.damping - D)]
    return np.concatenate(off) / np.sqrt(np.diag(fit.covariance))


def test_intervals_hold_where_motion_in_the_plane_is_noise(tmp_path):
    """Delays of the lasers, which are little known, are not laid on columns of the motion that are noise."""
    off = [deviations(tmp_path / "ldv.csv", seed) for seed in range(8)]
    assert np.all(np.sqrt(np.mean(np.square(off), axis=0)) < 1.5)


def test_leaks_of_lasers_are_no_motion_that_is_left_out(tmp_path):
    (tmp_path / "ldv.csv").write_text(table(0), encoding="utf-8")
    fit = fitted(tmp_path / "ldv.csv", inplane="ignore")
    assert fit.inplane.statistic > fit.inplane.threshold > fit.inplane.beyond_shared
    assert "neglected_motion" not in [notice.code for notice in fit.notices]
