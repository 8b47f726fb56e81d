"""The content of kd.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legacy.fitting.kd_fit import KDFit
from legacy.fitting.law_fits import LawFit
from legacy.fitting.ligament.inplane_stiffness import INPLANE_DOF
from legacy.fitting.model.model import NORMALISATION
from legacy.fitting.model.parameter_vector import split
from legacy.fitting.report.causes import causes_json
from legacy.stapeskit.arrays import finite_or_none

SCHEMA = "stapeskit.kd/1"


def kd_json(fit: KDFit, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result as JSON-able data, SI; what cannot be given is null.

    Parameters
    ----------
    provenance : mapping
        From stapeskit.provenance.record.
    """
    stiffness_sd, damping_sd = fit.standard_deviation
    noise = fit.noise_standard_deviation
    stiffness_passive, damping_passive = fit.passive
    return {
        "schema": SCHEMA,
        "dof": list(fit.dof),
        "about": "footplate_centre",
        "axes": "footplate",
        "model": _model(fit),
        "estimator": fit.options.estimator,
        "mass_matrix_si": _to_lists(fit.mass),
        "stiffness_si": _to_lists(fit.stiffness),
        "stiffness_sd_si": _to_lists(stiffness_sd),
        "damping_si": _to_lists(fit.damping),
        "damping_sd_si": _to_lists(damping_sd),
        "noise_only_sd_si": {"stiffness": _to_lists(noise[0]), "damping": _to_lists(noise[1])},
        "parameters": list(fit.parameters),
        "covariance_si": _to_lists(fit.covariance),
        "intervals_95_si": dict(zip(fit.parameters, _to_lists(fit.intervals), strict=True)),
        "intervals_method": "profile likelihood" if fit.profile is not None else "standard deviation",
        "budget": fit.budget.deviations(),
        "budget_share_of_variance": fit.budget.shares(),
        "stable": fit.modes.stable,
        "max_real_eigenvalue_1_s": finite_or_none(fit.modes.max_real_1_s),
        "passive": {"stiffness": stiffness_passive, "damping": damping_passive},
        "modes": _modes(fit),
        "overdamped_roots_1_s": list(fit.modes.overdamped_roots_1_s),
        "principal_axes": principal_axes_json(fit),
        "ligament": ligament_json(fit),
        **causes_json(fit),
        "fit": _fit(fit),
        "frequency_dependence": _frequency(fit),
        "identifiability": _identifiability(fit),
        "warnings": [notice.as_json() for notice in fit.notices],
        "provenance": dict(provenance),
    }


def _to_lists(values: NDArray[np.float64]) -> Any:
    """Return nested lists with null in place of what is not finite."""
    if values.ndim == 0:
        return finite_or_none(float(values))
    return [_to_lists(row) for row in values]


def _model(fit: KDFit) -> dict[str, Any]:
    choice = fit.inplane
    return {
        "equation": _equation(fit),
        "damping_law": fit.law.name,
        "dynamic_stiffness": fit.law.formula,
        "damping_exponent": fit.law.time_power,
        "damping_law_causal": fit.law.law.causal,
        "relaxation_time_s": fit.law.exponent
        if fit.law.estimated and fit.law.law.time_power is not None
        else None,
        "relaxation_time_ratio": _time_ratio(fit),
        "damping_exponent_sd": None if (law := _law_fit(fit)) is None else law.exponent_sd,
        "damping_unit_of_D11": fit.law.unit("N/m" if fit.dof[0] in "xyz" else "N m"),
        "damping_laws_compared": [
            {"law": law.law.name, "exponent": law.law.exponent, "chi2": law.chi2, "bic": law.bic}
            for law in fit.laws
        ],
        "damping_laws_alike": list(fit.laws_alike),
        "damping_laws_undetermined": dict(fit.undetermined),
        "inplane": {
            "option": fit.options.inplane,
            "used_as_load": choice.used,
            "dof": list(choice.dof),
            "reason": choice.reason,
            "statistic": choice.statistic,
            "threshold": choice.threshold,
            "largest_effect_relative": choice.largest_effect,
            "entry": choice.entry or None,
            "chi2_without": choice.chi2_without,
            "chi2_with": choice.chi2_with,
        },
        "robust": fit.options.robust,
        "structure": fit.options.structure,
        "base": fit.options.base,
        "runs": list(fit.observation.runs),
        "lines": len(fit.observation.freq_hz),
        "lines_dropped": fit.observation.dropped,
        "band_hz": [float(fit.observation.freq_hz.min()), float(fit.observation.freq_hz.max())],
        "excluded_hz": [list(band) for band in fit.options.exclude_hz],
    }


def _equation(fit: KDFit) -> str:
    """Return the equation of motion that was fitted, as text."""
    if fit.ligament is not None:
        fluid = "" if fit.ligament.fluid is None else " - w^2 M_f"
        return f"w^2 (M_r - Y M_c) q_s = (Z'(w){fluid}) (q_s - q_b)_r, Z = Z' + Y Z_cc Y^T"
    if fit.inplane.used:
        return "w^2 (M_rr q_r + M_rc q_c) = Z(w) (q_s - q_b)_r"
    return "w^2 M q_s = Z(w) (q_s - q_b)"


def ligament_json(fit: KDFit) -> dict[str, Any] | None:
    """Return the plane of the ligament with K and D about it, or None where it was not estimated."""
    ligament = fit.ligament
    if ligament is None:
        return None
    height, height_sd = ligament.height
    (about_x, about_x_sd), (about_z, about_z_sd) = ligament.tilt_rad
    stiffness_sd, damping_sd = split(np.sqrt(np.diag(ligament.plane_covariance)), len(fit.dof))
    inplane_sd = split(np.sqrt(np.diag(ligament.inplane.covariance)), len(INPLANE_DOF))
    return {
        "height_mm": 1e3 * height,
        "height_sd_mm": 1e3 * height_sd,
        "height_interval_95_mm": [1e3 * (height + sign * 1.96 * height_sd) for sign in (-1.0, 1.0)],
        "height_by_rocking_mm": {
            name: {"value": 1e3 * value, "sd": 1e3 * sd}
            for name, value, sd in zip(
                ("alpha", "gamma"), ligament.heights_m, ligament.heights_sd_m, strict=True
            )
        },
        "height_of": "the plane of the ligament above the footplate centre, + lateral",
        "tilt_deg": {
            "about_x": finite_or_none(float(np.degrees(about_x))),
            "about_x_sd": finite_or_none(float(np.degrees(about_x_sd))),
            "about_z": finite_or_none(float(np.degrees(about_z))),
            "about_z_sd": finite_or_none(float(np.degrees(about_z_sd))),
        },
        "coupling_si": _to_lists(ligament.coupling),
        "coupling_sd_si": _to_lists(np.sqrt(np.diag(ligament.coupling_covariance)).reshape(3, 3)),
        "coupling_rows": list(fit.dof),
        "coupling_columns": list(INPLANE_DOF),
        "about_ligament_plane": {
            "about": "footplate centre, raised by the height along y",
            "stiffness_si": _to_lists(ligament.plane_stiffness),
            "stiffness_sd_si": _to_lists(stiffness_sd),
            "damping_si": _to_lists(ligament.plane_damping),
            "damping_sd_si": _to_lists(damping_sd),
            "covariance_si": _to_lists(ligament.plane_covariance),
        },
        "inplane": {
            "dof": list(INPLANE_DOF),
            "determined": ligament.inplane.determined,
            "stiffness_si": _to_lists(ligament.inplane.stiffness),
            "stiffness_sd_si": _to_lists(inplane_sd[0]),
            "damping_si": _to_lists(ligament.inplane.damping),
            "damping_sd_si": _to_lists(inplane_sd[1]),
        },
        "p_value": finite_or_none(ligament.p_value),
        "shared_errors": len(ligament.lines.sources),
        "without_inplane_motion": _describe_plain_fit(fit),
    }


def _describe_plain_fit(fit: KDFit) -> dict[str, Any] | None:
    """Return what the three degrees of freedom alone would have given."""
    plain = fit.plain
    if plain is None:
        return None
    stiffness, damping = split(plain.estimate.parameters * plain.problem.units, len(fit.dof))
    return {
        "stiffness_si": _to_lists(stiffness),
        "damping_si": _to_lists(damping),
        "chi2": plain.chi2,
        "n_dof": plain.n_dof,
    }


def _law_fit(fit: KDFit) -> LawFit | None:
    return next((law for law in fit.laws if law.law == fit.law), None)


def _time_ratio(fit: KDFit) -> dict[str, float] | None:
    """Return the second relaxation time over the first, and the standard deviation of its logarithm."""
    law = _law_fit(fit)
    if law is None or not law.law.law.ratios:
        return None
    return {"value": law.law.ratio, "sd_of_logarithm": float(law.law_sd[1])}


def _modes(fit: KDFit) -> list[dict[str, Any]]:
    mode_list = []
    for place, mode in enumerate(fit.modes.pairs):
        mode_list.append(
            {
                "frequency_hz": mode.frequency_hz,
                "frequency_sd_hz": finite_or_none(fit.derived.frequency_sd_hz[place]),
                "undamped_frequency_hz": mode.undamped_frequency_hz,
                "undamped_frequency_sd_hz": finite_or_none(fit.derived.undamped_frequency_sd_hz[place]),
                "damping_ratio": mode.damping_ratio,
                "damping_ratio_sd": finite_or_none(fit.derived.damping_ratio_sd[place]),
                "shape_re": mode.shape.real.tolist(),
                "shape_im": mode.shape.imag.tolist(),
                "shape_magnitude_sd": _to_lists(fit.derived.shape_sd[place]),
                "normalisation": NORMALISATION,
            }
        )
    return mode_list


def principal_axes_json(fit: KDFit) -> dict[str, Any] | None:
    """Return the principal axes in mm and degrees with their sd, or None for other degrees of freedom."""
    values, sd = fit.derived.principal, fit.derived.principal_sd
    if values is None or sd is None:
        return None
    return {
        "origin_x_mm": values[0] * 1e3,
        "origin_x_sd_mm": finite_or_none(sd[0] * 1e3),
        "origin_z_mm": values[1] * 1e3,
        "origin_z_sd_mm": finite_or_none(sd[1] * 1e3),
        "angle_deg": float(np.degrees(values[2])),
        "angle_sd_deg": finite_or_none(float(np.degrees(sd[2]))),
        "stiffness_si": values[3:].tolist(),
        "stiffness_sd_si": _to_lists(sd[3:]),
    }


def _fit(fit: KDFit) -> dict[str, Any]:
    return {
        "chi2": fit.chi2,
        "n_dof": fit.n_dof,
        "chi2_with_shared_errors": fit.joint_chi2,
        "chi2_per_dof": fit.chi2 / fit.n_dof if fit.n_dof > 0 else None,
        "iterations": fit.estimate.iterations,
        "converged": fit.estimate.converged,
        "active_constraints": list(fit.estimate.active),
        "optimality_certificate": fit.estimate.certificate,
        "noise_covariance_method": fit.budget.method,
        "noise_covariance_scaled_by": fit.budget.widened,
        "estimated_bias_si": dict(zip(fit.parameters, fit.budget.bias.tolist(), strict=True)),
    }


def _frequency(fit: KDFit) -> dict[str, Any] | None:
    dependence = fit.frequency
    if dependence is None:
        return None
    return {
        "bands_hz": [
            [float(low), float(high)] for low, high in zip(dependence.low_hz, dependence.high_hz, strict=True)
        ],
        "lines": [int(count) for count in dependence.lines],
        "stiffness_factor": _to_lists(dependence.stiffness),
        "stiffness_factor_sd": _to_lists(dependence.stiffness_sd),
        "damping_factor": _to_lists(dependence.damping),
        "damping_factor_sd": _to_lists(dependence.damping_sd),
        "relative_to": "K and D of the whole band; the factors' means, weighted by information, are 1",
        "verdict": dependence.verdict,
        "chi2": finite_or_none(dependence.chi2),
        "n_dof": dependence.n_dof,
        "p_value": finite_or_none(dependence.p_value),
    }


def _identifiability(fit: KDFit) -> dict[str, Any]:
    known = fit.identifiability
    return {
        "condition_number_column_scaled": finite_or_none(known.condition),
        "fisher_eigenvalues_relative": _to_lists(known.eigenvalues),
        "worst_combinations": [
            {"relative_sd": finite_or_none(sd), "combination": known.describe(place), "entries": dict(parts)}
            for place, (sd, parts) in enumerate(known.combinations)
        ],
        "cramer_rao_bound_si": dict(zip(known.names, _to_lists(known.bound_si), strict=True)),
        "cramer_rao_bound_relative": dict(zip(known.names, _to_lists(known.relative), strict=True)),
        "entries_over_10_percent": [
            name for name, value in zip(known.names, known.relative, strict=True) if value > 0.1
        ],
        "relative_to": "sqrt(Xii Xjj) for entry (i, j) of X = K or D",
        "weak": known.weak,
    }
