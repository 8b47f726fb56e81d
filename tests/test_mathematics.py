"""The formulas of docs/mathematics.md, checked symbolically and against the library."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from stapeskit.spatial import matrix_from_parameters

PAGE = Path(__file__).resolve().parents[1] / "docs" / "mathematics.md"


def cross(vector):
    import sympy as sp

    a, b, c = vector
    return sp.Matrix([[0, -c, b], [c, 0, -a], [-b, a, 0]])


def symbols(names):
    import sympy as sp

    return sp.Matrix(sp.symbols(names, real=True))


def block(rows):
    import sympy as sp

    return sp.Matrix(sp.BlockMatrix(rows).as_explicit())


def test_every_formula_has_a_check():
    text = PAGE.read_text(encoding="utf-8")
    assert [int(number) for number in re.findall(r"^\*\*(\d+)\.", text, re.MULTILINE)] == list(range(1, 14))


def test_1_a_beam_is_one_row():
    import sympy as sp

    d, v, w, p = (symbols(f"{name}1:4") for name in "dvwp")
    reading = d.dot(v + w.cross(p))
    row = list(d) + list(p.cross(d))
    assert sp.expand(reading - sum(a * b for a, b in zip(row, [*v, *w], strict=True))) == 0


def test_2_kinetic_energy_gives_the_mass_matrix():
    import sympy as sp

    m1, m2 = sp.symbols("m1 m2", positive=True)
    first, second, v, w = (symbols(f"{name}1:4") for name in "abvw")
    mass = m1 + m2
    moment = m1 * first + m2 * second  # mass times the centre of mass
    inertia = -m1 * cross(first) ** 2 - m2 * cross(second) ** 2
    matrix = block([[mass * sp.eye(3), -cross(moment)], [cross(moment), inertia]])
    energy = sum(m * (v + w.cross(p)).dot(v + w.cross(p)) for m, p in ((m1, first), (m2, second))) / 2
    q = sp.Matrix([*v, *w])
    assert sp.expand(energy - (q.T * matrix * q)[0] / 2) == 0
    assert sp.expand(matrix[1, 3] + moment[2]) == 0
    assert sp.expand(matrix[1, 5] - moment[0]) == 0
    assert sp.expand(matrix[3, 5] + m1 * first[0] * first[2] + m2 * second[0] * second[2]) == 0


def test_3_power_does_not_depend_on_the_reference_point():
    import sympy as sp

    s, v, w, p = (symbols(f"{name}1:4") for name in "svwp")
    shift = block([[sp.eye(3), -cross(s)], [sp.zeros(3, 3), sp.eye(3)]])
    moved = shift * sp.Matrix([*v, *w])
    at_p = v + w.cross(p)
    assert sp.expand(sp.Matrix(moved[:3]) + w.cross(p - s) - at_p) == sp.zeros(3, 1)
    given = sp.Matrix(6, 6, lambda i, j: sp.Symbol(f"k{min(i, j)}{max(i, j)}"))
    q = sp.Matrix([*v, *w])
    power = (moved.T * given * moved)[0] - (q.T * (shift.T * given * shift) * q)[0]
    assert sp.expand(power) == 0


def test_4_the_response_solves_the_equation_of_motion():
    import sympy as sp

    w, m, d, k, base = sp.symbols("w m d k b", positive=True)
    response = (k + sp.I * w * d) / (-(w**2) * m + sp.I * w * d + k) * base
    left, right = w**2 * m * response, (k + sp.I * w * d) * (response - base)
    assert sp.simplify(left - right) == 0


def test_5_mean_power_of_the_ligament():
    import sympy as sp

    t, w, k, d, a = sp.symbols("t w k d a", positive=True)
    deflection = a * sp.cos(w * t)
    rate = sp.diff(deflection, t)
    mean = sp.integrate((k * deflection + d * rate) * rate, (t, 0, 2 * sp.pi / w)) * w / (2 * sp.pi)
    assert sp.simplify(mean - w**2 * d * a**2 / 2) == 0


def test_6_a_shift_removes_the_couplings_of_y():
    import sympy as sp

    k = sp.Matrix(3, 3, lambda i, j: sp.Symbol(f"k{min(i, j)}{max(i, j)}"))
    x, z = sp.symbols("x0 z0")
    # y of the point (x, 0, z) is y - z alpha + x gamma
    here = sp.Matrix([[1, -z, x], [0, 1, 0], [0, 0, 1]])
    back = here.inv()
    moved = sp.expand(back.T * k * back)
    found = {x: k[0, 2] / k[0, 0], z: -k[0, 1] / k[0, 0]}
    assert sp.simplify(moved[0, 1].subs(found)) == 0
    assert sp.simplify(moved[0, 2].subs(found)) == 0


def mean(expression, variances):
    import sympy as sp

    """Return the expectation over independent variables of mean zero, in which it is of second degree."""
    total = 0
    for powers, factor in sp.Poly(expression, *variances).terms():
        assert max(powers) <= 2
        if 1 not in powers:
            total += factor * sp.prod(v for n, v in zip(powers, variances.values(), strict=True) if n == 2)
    return total


def test_7_noise_in_the_regressor_shrinks_the_slope_symbolically():
    import sympy as sp

    d, e = sp.symbols("d e", real=True)  # deflection and its noise
    k, power, noise = sp.symbols("K S s2", positive=True)
    seen, load = d + e, k * d
    variances = {d: power, e: noise}
    # the slope of least squares over many lines is E[A b] / E[A A] (law of large numbers)
    slope = mean(seen * load, variances) / mean(seen * seen, variances)
    assert sp.simplify(slope - k * power / (power + noise)) == 0


def test_8_damped_frequency():
    import sympy as sp

    m, d, k = sp.symbols("m d k", positive=True)
    root = (-d + sp.sqrt(d**2 - 4 * k * m)) / (2 * m)
    zeta, natural = d / (2 * sp.sqrt(k * m)), sp.sqrt(k / m)
    numbers = {m: 3.2e-6, d: 0.0229, k: 1722.0}
    damped = (natural * sp.sqrt(1 - zeta**2)).subs(numbers)
    assert float(sp.im(root.subs(numbers).evalf())) == pytest.approx(float(damped), rel=1e-12)
    assert sp.simplify(m * root**2 + d * root + k) == 0


def test_9_stiffness_of_a_cantilever():
    import sympy as sp

    x, length, rigidity, force, moment = sp.symbols("x l EI F T")
    bending = (force * (length - x) + moment) / rigidity
    slope = sp.integrate(bending, (x, 0, x))
    deflection = sp.integrate(slope, (x, 0, x))
    # the rotation alpha turns a beam along +z by -alpha
    tip = sp.Matrix([deflection.subs(x, length), -slope.subs(x, length)])
    loads = sp.Matrix([force, -moment])
    compliance = tip.jacobian([force, moment]) * sp.diag(1, -1)
    expected = rigidity * sp.Matrix([[12 / length**3, 6 / length**2], [6 / length**2, 4 / length]])
    assert sp.simplify(compliance.inv() - expected) == sp.zeros(2, 2)
    assert sp.simplify(expected * tip - loads) == sp.zeros(2, 1)


def test_10_errors_of_the_predictor_shrink_a_law_symbolically():
    import sympy as sp

    p, e = sp.symbols("p e", real=True)  # log P about its mean, and its error
    a, b = sp.symbols("a b", real=True)
    spread, error = sp.symbols("V t2", positive=True)
    seen, response = p + e, a + b * p
    variances = {p: spread, e: error}
    slope = mean(seen * response, variances) / mean(seen * seen, variances)
    assert sp.simplify(slope - b * spread / (spread + error)) == 0


def test_11_a_product_of_triangles_is_passive_and_its_derivative():
    import sympy as sp

    a, b, c, u, v, w, e = sp.symbols("a b c u v w e", real=True)
    factor, step = sp.Matrix([[a, 0], [b, c]]), sp.Matrix([[u, 0], [v, w]])
    moved = (factor + e * step) * (factor + e * step).T
    first = sp.diff(moved, e).subs(e, 0)
    assert sp.expand(first - step * factor.T - factor * step.T) == sp.zeros(2, 2)
    assert sp.expand(sp.diff(moved, e, 2) / 2 - step * step.T) == sp.zeros(2, 2)
    x, y = sp.symbols("x y", real=True)
    motion = sp.Matrix([x, y])
    power = (motion.T * factor * factor.T * motion)[0]
    assert sp.expand(power - (a * x + b * y) ** 2 - (c * y) ** 2) == 0


def test_12_the_least_change_that_fulfils_the_equations():
    import sympy as sp

    b1, b2, y1, y2 = sp.symbols("b1 b2 y1 y2", real=True)
    c11, c22, c12 = sp.symbols("c11 c22 c12", real=True)
    equation, seen = sp.Matrix([[b1, b2]]), sp.Matrix([y1, y2])
    covariance = sp.Matrix([[c11, c12], [c12, c22]])
    inner = (equation * covariance * equation.T)[0]
    error = (equation * seen)[0]
    fitted = seen - covariance * equation.T * error / inner
    assert sp.simplify((equation * fitted)[0]) == 0
    change = seen - fitted
    least = (change.T * covariance.inv() * change)[0]
    assert sp.simplify(least - error**2 / inner) == 0
    # any other motion on the line differs along (b2, -b1), across which the change is orthogonal to it
    along = sp.Matrix([b2, -b1])
    assert sp.simplify((along.T * covariance.inv() * change)[0]) == 0


def test_13_centre_of_stiffness_of_a_rim_that_varies_linearly():
    import sympy as sp

    angle = sp.Symbol("theta", real=True)
    radius, level, gx, gz, cx, cz = sp.symbols("r k gx gz cx cz", positive=True)
    x, z = cx + radius * sp.cos(angle), cz + radius * sp.sin(angle)
    stiffness = level * (1 + gx * (x - cx) + gz * (z - cz))

    def around(integrand):
        return sp.integrate(sp.expand(integrand * radius), (angle, 0, 2 * sp.pi))

    piston, alpha, gamma = around(stiffness), around(-stiffness * z), around(stiffness * x)
    second = radius**2 / 2  # of a circle, divided by its length
    assert sp.simplify(gamma / piston - cx - second * gx) == 0
    assert sp.simplify(-alpha / piston - cz - second * gz) == 0


def test_the_mass_matrix_of_the_library_is_that_of_the_page():
    mass, moment = 3.2e-6, np.array([1e-10, 3e-9, 4e-10])
    inertia = np.array([[7.0, -0.3, 0.1], [-0.3, 2.0, 0.2], [0.1, 0.2, 9.0]]) * 1e-12
    skew = np.array(cross(list(moment))).astype(float)
    page = np.block([[mass * np.eye(3), -skew], [skew, inertia]])
    tensor = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))]
    assert np.allclose(matrix_from_parameters(np.array([mass, *moment, *tensor])), page, rtol=1e-15, atol=0.0)
