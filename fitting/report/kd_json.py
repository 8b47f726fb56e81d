"""The content of kd.json."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fitting import entries
from fitting.checks import active_constraints
from fitting.evidence import found_from
from fitting.likelihood import LOAD, PLANE
from fitting.model import NORMALISATION
from fitting.plane import INPLANE_DOF
from fitting.ring import ring_of
from fitting.solve import bic, entry_scale
from stapeskit.arrays import Array, finite_or_none
from stapeskit.documents import as_json
from stapeskit.report.quantities import si_unit

if TYPE_CHECKING:
    from fitting.result import KDFit

SCHEMA = "stapeskit.kd/1"
RELATIVE = "sqrt(Xii Xjj) for entry (i, j) of X = K or D"


def kd_json(fit: KDFit) -> dict[str, Any]:
    """Return a result as JSON-able data, SI; what cannot be given is null."""
    noise = fit.noise_standard_deviation
    content = {
        "schema": SCHEMA,
        "dof": list(fit.dof),
        "about": "footplate_centre",
        "axes": "footplate",
        "verdict": fit.verdict.as_json(),
        "model": _model(fit),
        "estimator": fit.options.estimator,
        "mass_matrix_si": fit.mass,
        **_pair(fit.values, _sd_of(fit.covariance), len(fit.dof)),
        "noise_only_sd_si": {"stiffness": noise[0], "damping": noise[1]},
        "parameters": list(fit.parameters),
        "covariance_si": fit.covariance,
        "intervals_95_si": _named(fit, fit.intervals),
        "budget": {source: _named(fit, _sd_of(part)) for source, part in fit.budget.items()},
        "stable": fit.modes.stable,
        "max_real_eigenvalue_1_s": fit.modes.max_real_1_s,
        "passive": dict(zip(("stiffness", "damping"), fit.passive, strict=True)),
        "modes": _modes(fit),
        "overdamped_roots_1_s": list(fit.modes.overdamped_roots_1_s),
        "principal_axes": _principal_axes(fit),
        "ligament": _ligament(fit),
        "ring": _ring(fit),
        "unknowns": [
            {"name": unknown.name, "value": value, "sd": sd, "unit": unknown.unit,
             "asked_for": unknown.name in fit.options.unknowns}
            for unknown, value, sd in fit.unknowns
        ],
        "causes": _causes(fit),
        "fit": _fit(fit),
        "frequency_dependence": _bands(fit),
        "identifiability": _identifiability(fit),
        "warnings": [notice.as_json() for notice in fit.notices],
        "provenance": {key: value for key, value in fit.provenance.items() if key != "motion_provenance"},
    }  # fmt: skip
    if fit.scatter is not None:
        rms, stated = fit.scatter.standard_deviation, _sd_of(fit.covariance)
        content["monte_carlo"] = {
            "refits": len(fit.scatter.errors),
            "failed": fit.scatter.failed,
            "rms_error_si": _named(fit, rms),
            "rms_error_over_stated_sd": _named(fit, rms / np.where(stated > 0.0, stated, np.inf)),
        }
    plain: dict[str, Any] = as_json(content)
    return plain


def _named(fit: KDFit, values: Array) -> dict[str, Any]:
    """Return values of the parameters by their names."""
    return dict(zip(fit.parameters, values.tolist(), strict=True))


def _sd_of(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _pair(values: Array, sds: Array, n: int) -> dict[str, Array]:
    """Return K and D with their standard deviations as matrices."""
    parts = (*entries.split(values, n), *entries.split(sds, n))
    names = ("stiffness_si", "damping_si", "stiffness_sd_si", "damping_sd_si")
    return dict(zip(names, parts, strict=True))


def _model(fit: KDFit) -> dict[str, Any]:
    found, law, data = fit.found, fit.law, fit.found.data
    level = max(1.0, min((one.level for one in fit.solution.laws.values()), default=1.0))
    exponent_sd = None
    if law.free:
        place = found.at["law"].start
        exponent_sd = float(np.sqrt(found.covariance[place, place]))
        exponent_sd /= data.reference if law.kind.is_time else 1.0
    motion = found.likelihood.model.motion
    return {
        "equation": equation(fit),
        "damping_law": law.name,
        "dynamic_stiffness": law.formula,
        "damping_exponent": law.time_power,
        "relaxation_time_s": law.value if law.kind.is_time else None,
        "damping_exponent_sd": exponent_sd,
        "damping_unit_of_D11": si_unit("D", fit.dof[0], fit.dof[0], law.time_power),
        "damping_laws_compared": [
            {"law": name, "exponent": one.law.value or None, "chi2": one.chi2, "bic": bic(one, level)}
            for name, one in fit.solution.laws.items()
        ],
        "damping_laws_alike": list(fit.solution.laws_alike),
        "inplane": {
            "used_as_load": motion in (LOAD, PLANE),
            "dof": [data.measured[place] for place in data.columns],
            "plane_estimated": motion == PLANE,
        },
        "structure": fit.options.structure,
        "base": fit.options.base,
        "runs": list(data.runs),
        "lines": data.count,
        "band_hz": [data.freq_hz.min(), data.freq_hz.max()],
        "excluded_hz": [list(band) for band in fit.options.exclude_hz],
    }


def equation(fit: KDFit) -> str:
    """Return the equation of motion that was fitted, as text."""
    model = fit.found.likelihood.model
    fluid = " - w^2 M_f" if any(unknown.name == "fluid" for unknown in model.unknowns) else ""
    if model.motion == PLANE:
        return f"w^2 (M_r - Y M_c) q_s = (Z'(w){fluid}) (q_s - q_b)_r, Z = Z' + Y Z_cc Y^T"
    if model.motion == LOAD:
        return f"w^2 (M_rr q_r + M_rc q_c) = (Z(w){fluid}) (q_s - q_b)_r"
    return f"w^2 M q_s = (Z(w){fluid}) (q_s - q_b)"


def _modes(fit: KDFit) -> list[dict[str, Any]]:
    derived = fit.derived
    return [
        {
            "frequency_hz": mode.frequency_hz,
            "frequency_sd_hz": derived.frequency_sd_hz[place],
            "undamped_frequency_hz": mode.undamped_frequency_hz,
            "undamped_frequency_sd_hz": derived.undamped_sd_hz[place],
            "damping_ratio": mode.damping_ratio,
            "damping_ratio_sd": derived.ratio_sd[place],
            "shape_re": mode.shape.real,
            "shape_im": mode.shape.imag,
            "shape_magnitude_sd": derived.shape_sd[place],
            "normalisation": NORMALISATION,
        }
        for place, mode in enumerate(fit.modes.pairs)
    ]


def _principal_axes(fit: KDFit) -> dict[str, Any] | None:
    """Return the principal axes in mm and degrees with their sd, or None for other degrees of freedom."""
    values, sd = fit.derived.axes, fit.derived.axes_sd
    if values is None or sd is None:
        return None
    content: dict[str, Any] = {}
    for place, name in enumerate(("origin_x", "origin_z")):
        content |= {f"{name}_mm": 1e3 * values[place], f"{name}_sd_mm": 1e3 * sd[place]}
    content |= {"angle_deg": np.degrees(values[2]), "angle_sd_deg": np.degrees(sd[2])}
    return {**content, "stiffness_si": values[3:], "stiffness_sd_si": sd[3:]}


def _ligament(fit: KDFit) -> dict[str, Any] | None:
    plane, height = fit.plane, fit.height
    if plane is None or height is None:
        return None
    off = fit.draws.plane_draws - fit.draws.plane_estimate
    return {
        "height_mm": 1e3 * height[0],
        "height_sd_mm": 1e3 * height[1],
        "coupling_si": fit.coupling,
        "coupling_sd_si": _sd_of(fit.coupling_covariance).reshape(3, 3),
        "coupling_rows": list(fit.dof),
        "coupling_columns": list(INPLANE_DOF),
        "about_ligament_plane": {
            "about": "footplate centre, raised by the height along y",
            **_pair(fit.draws.plane_estimate, np.sqrt(np.mean(off**2, axis=0)), len(fit.dof)),
        },
        "inplane": {
            "dof": list(INPLANE_DOF),
            "determined": plane.determined,
            "p_value": plane.p_value,
            **_pair(plane.entries, _sd_of(plane.covariance), 3),
        },
    }


def _ring(fit: KDFit) -> dict[str, Any] | None:
    ring = ring_of(fit)
    if ring is None:
        return None
    shear, loss = (
        dict(zip(("value", "sd"), pair, strict=True)) for pair in (ring.shear_pa, ring.loss_factor)
    )
    return {
        "rim_length_mm": 1e3 * ring.length_m,
        "shear_modulus_times_thickness_over_width_pa": shear,
        "loss_factor": loss,
        "rocking_measured_over_ring": dict(zip(("near_x", "near_z"), ring.rocking_ratio, strict=True)),
    }


def _causes(fit: KDFit) -> dict[str, Any] | None:
    """Return the search for causes: scores, refits with their odds, the best explanation."""
    search = fit.solution.search
    if not search.scores:
        return None
    return {
        "best": None if search.best is None else search.best.name,
        "cannot_be_distinguished": [other.name for other in search.look_alikes],
        "refits": [
            {
                "name": other.name,
                "size": other.value,
                "sd": other.sd,
                "unit": other.unit,
                "log_odds": other.log_odds,
                "weight": weight,
                "chi2": other.found.chi2,
                "explains_the_data": other.found.explained,
            }
            for other, weight in zip(search.alternatives, search.weights, strict=True)
        ],
        "scores": [
            {
                "name": score.unknown.name,
                "size": score.value,
                "sd": score.sd,
                "unit": score.unknown.unit,
                "log_odds": score.log_odds,
                "found_from": found_from(score),
            }
            for score in search.scores
        ],
    }


def _fit(fit: KDFit) -> dict[str, Any]:
    found, book = fit.found, fit.solution.textbook
    content = {
        "chi2": found.chi2,
        "n_dof": found.n_dof,
        "chi2_per_dof": found.chi2 / found.n_dof if found.n_dof > 0 else None,
        "p_value": found.p_value,
        "iterations": found.evaluations,
        "converged": found.converged,
        "active_constraints": list(active_constraints(fit)),
        "noise_covariance_scaled_by": max(1.0, found.level),
    }
    return content if book is None else content | {
        "estimated_bias_si": _named(fit, book.bias * entry_scale(found))
    }  # fmt: skip


def _bands(fit: KDFit) -> dict[str, Any] | None:
    bands = fit.solution.bands
    return None if bands is None else {
        "bands_hz": bands.ends_hz,
        "stiffness_factor": bands.factors[0],
        "stiffness_factor_sd": bands.sd[0],
        "damping_factor": bands.factors[1],
        "damping_factor_sd": bands.sd[1],
        "relative_to": "K and D of the whole band; the factors' means, weighted by information, are 1",
        "chi2": bands.chi2,
        "n_dof": bands.n_dof,
        "p_value": bands.p_value,
    }  # fmt: skip


def _identifiability(fit: KDFit) -> dict[str, Any]:
    return {
        "worst_combinations": [
            {"relative_sd": finite_or_none(sd), "entries": parts} for sd, parts in fit.combinations[:3]
        ],
        "cramer_rao_bound_si": _named(fit, fit.bound),
        "relative_to": RELATIVE,
    }
