"""The content of kd.json."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting import entries
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
    noise = entries.split(fit.noise_sd, len(fit.dof))
    content = {
        "schema": SCHEMA,
        "dof": fit.dof,
        "about": "footplate_centre",
        "axes": "footplate",
        "verdict": fit.verdict.as_json(),
        "model": _model(fit),
        "estimator": fit.options.estimator,
        "mass_matrix_si": fit.mass,
        **_pair(fit.values, fit.sd, len(fit.dof)),
        "noise_only_sd_si": {"stiffness": noise[0], "damping": noise[1]},
        "parameters": fit.parameters,
        "covariance_si": fit.covariance,
        "intervals_95_si": _named(fit, fit.intervals),
        "budget": {source: _named(fit, _sd_of(part)) for source, part in fit.budget.items()},
        "stable": fit.modes.stable,
        "max_real_eigenvalue_1_s": fit.modes.max_real_1_s,
        "passive": dict(zip(("stiffness", "damping"), fit.passive, strict=True)),
        "modes": _modes(fit),
        "overdamped_roots_1_s": fit.modes.overdamped_roots_1_s,
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
        "frequency_dependence": None if fit.bands is None else asdict(fit.bands) | {
            "relative_to": "K and D of the whole band; the factors' means, weighted by information, are 1"
        },
        "identifiability": {
            "worst_combinations": [
                {"relative_sd": finite_or_none(sd), "entries": parts} for sd, parts in fit.combinations[:3]
            ],
            "cramer_rao_bound_si": _named(fit, fit.bound),
            "relative_to": RELATIVE,
        },
        "warnings": [notice.as_json() for notice in fit.notices],
        "provenance": {key: value for key, value in fit.provenance.items() if key != "motion_provenance"},
    }  # fmt: skip
    if fit.scatter is not None:
        rms = fit.scatter.standard_deviation
        content["monte_carlo"] = {
            "refits": len(fit.scatter.errors),
            "failed": fit.scatter.failed,
            "rms_error_si": _named(fit, rms),
            "rms_error_over_stated_sd": _named(fit, rms / np.where(fit.sd > 0.0, fit.sd, np.inf)),
        }
    plain: dict[str, Any] = as_json(content)
    return plain


def _of(thing: object, names: str) -> dict[str, Any]:
    """Return some attributes by their names."""
    return {name: getattr(thing, name) for name in names.split()}


def _named(fit: KDFit, values: Array) -> dict[str, Any]:
    """Return values of the parameters by their names."""
    return dict(zip(fit.parameters, values.tolist(), strict=True))


def _sd_of(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _pair(values: Array, sds: Array, n: int) -> dict[str, Array]:
    """Return K and D with their standard deviations as matrices."""
    parts = (*entries.split(values, n), *entries.split(sds, n))
    return dict(zip(("stiffness_si", "damping_si", "stiffness_sd_si", "damping_sd_si"), parts, strict=True))


def _model(fit: KDFit) -> dict[str, Any]:
    found, law, data = fit.found, fit.law, fit.found.data
    level = max(1.0, min((one.level for one in fit.laws.values()), default=1.0))
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
            for name, one in fit.laws.items()
        ],
        "damping_laws_alike": fit.laws_alike,
        "inplane": {
            "used_as_load": motion in (LOAD, PLANE),
            "dof": [data.measured[place] for place in data.columns],
            "plane_estimated": motion == PLANE,
        },
        "structure": fit.options.structure,
        "base": fit.options.base,
        "runs": data.runs,
        "lines": data.count,
        "band_hz": [data.freq_hz.min(), data.freq_hz.max()],
        "excluded_hz": fit.options.exclude_hz,
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
            **_of(mode, "frequency_hz undamped_frequency_hz damping_ratio"),
            "frequency_sd_hz": derived.frequency_sd_hz[place],
            "undamped_frequency_sd_hz": derived.undamped_sd_hz[place],
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
    return {
        "origin_x_mm": 1e3 * values[0],
        "origin_x_sd_mm": 1e3 * sd[0],
        "origin_z_mm": 1e3 * values[1],
        "origin_z_sd_mm": 1e3 * sd[1],
        "angle_deg": np.degrees(values[2]),
        "angle_sd_deg": np.degrees(sd[2]),
        "stiffness_si": values[3:],
        "stiffness_sd_si": sd[3:],
    }


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
        "coupling_rows": fit.dof,
        "coupling_columns": INPLANE_DOF,
        "about_ligament_plane": {
            "about": "footplate centre, raised by the height along y",
            **_pair(fit.draws.plane_estimate, np.sqrt(np.mean(off**2, axis=0)), len(fit.dof)),
        },
        "inplane": {
            "dof": INPLANE_DOF,
            "determined": plane.determined,
            "p_value": plane.p_value,
            **_pair(plane.entries, _sd_of(plane.covariance), 3),
        },
    }


def _ring(fit: KDFit) -> dict[str, Any] | None:
    ring = ring_of(fit)
    if ring is None:
        return None
    (shear, shear_sd), (loss, loss_sd), (near_x, near_z) = ring.shear_pa, ring.loss_factor, ring.rocking_ratio
    return {
        "rim_length_mm": 1e3 * ring.length_m,
        "shear_modulus_times_thickness_over_width_pa": {"value": shear, "sd": shear_sd},
        "loss_factor": {"value": loss, "sd": loss_sd},
        "rocking_measured_over_ring": {"near_x": near_x, "near_z": near_z},
    }


def _causes(fit: KDFit) -> dict[str, Any] | None:
    """Return the search for causes: scores, refits with their odds, the best explanation."""
    search = fit.search
    if not search.scores:
        return None
    return {
        "best": None if search.best is None else search.best.name,
        "cannot_be_distinguished": [other.name for other in search.look_alikes],
        "refits": [
            {
                **_of(other, "name sd unit log_odds"),
                "size": other.value,
                "weight": weight,
                "chi2": other.found.chi2,
                "explains_the_data": other.found.explained,
            }
            for other, weight in zip(search.alternatives, search.weights, strict=True)
        ],
        "scores": [
            _of(score, "sd log_odds") | _of(score.unknown, "name unit") | {"size": score.value}
            for score in search.scores
        ],
    }


def _fit(fit: KDFit) -> dict[str, Any]:
    found = fit.found
    content = {
        **_of(found, "chi2 n_dof p_value converged"),
        "chi2_per_dof": found.chi2 / found.n_dof if found.n_dof > 0 else None,
        "iterations": found.evaluations,
        "active_constraints": fit.active,
        "noise_covariance_scaled_by": found.data.widened * max(1.0, found.level),
    }
    if fit.bias is not None:
        content["estimated_bias_si"] = _named(fit, fit.bias * entry_scale(found))
    return content
