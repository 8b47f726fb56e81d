"""The content of kd.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting import entries
from fitting.checks import active_constraints
from fitting.evidence import LOOK_ALIKE
from fitting.likelihood import LOAD, PLANE
from fitting.model import NORMALISATION
from fitting.plane import INPLANE_DOF
from fitting.ring import RingTest, Value, ring_test
from fitting.solve import bic, entry_scale
from stapeskit.arrays import Array, finite_or_none
from stapeskit.records.json_files import as_json

if TYPE_CHECKING:
    from fitting.result import KDFit

SCHEMA = "stapeskit.kd/1"


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
        **_pair(fit.values, np.sqrt(np.diag(fit.covariance)), len(fit.dof)),
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
        "principal_axes": principal_axes_json(fit),
        "ligament": _ligament(fit),
        "ring": _ring(fit),
        "unknowns": _unknowns(fit),
        "causes": _causes(fit),
        "fit": _fit(fit),
        "frequency_dependence": _bands(fit),
        "identifiability": _identifiability(fit),
        "warnings": [notice.as_json() for notice in fit.notices],
        "provenance": {key: value for key, value in fit.provenance.items() if key != "motion_provenance"},
    }
    if fit.scatter is not None:
        content["monte_carlo"] = fit.scatter.as_json(fit)
    plain: dict[str, Any] = as_json(content)
    return plain


def _named(fit: KDFit, values: Array) -> dict[str, Any]:
    """Return values of the parameters by their names."""
    return dict(zip(fit.parameters, values.tolist(), strict=True))


def _sd_of(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _pair(values: Array, sds: Array, n: int) -> dict[str, Array]:
    """Return K and D with their standard deviations as matrices."""
    (stiffness, damping), (stiffness_sd, damping_sd) = entries.split(values, n), entries.split(sds, n)
    return {
        "stiffness_si": stiffness,
        "stiffness_sd_si": stiffness_sd,
        "damping_si": damping,
        "damping_sd_si": damping_sd,
    }


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
        "damping_law_causal": law.kind.causal,
        "relaxation_time_s": law.value if law.kind.is_time else None,
        "damping_exponent_sd": exponent_sd,
        "damping_unit_of_D11": law.damping_unit("N/m" if fit.dof[0] in "xyz" else "N m"),
        "damping_laws_compared": [
            {"law": name, "exponent": one.law.value or None, "chi2": one.chi2, "bic": bic(one, level)}
            for name, one in fit.solution.laws.items()
        ],
        "damping_laws_alike": list(fit.solution.laws_alike),
        "damping_laws_undetermined": list(fit.solution.undetermined),
        "inplane": {
            "option": fit.options.inplane,
            "used_as_load": motion in (LOAD, PLANE),
            "dof": [data.measured[place] for place in data.columns],
            "plane_estimated": motion == PLANE,
        },
        "robust": fit.options.robust,
        "structure": fit.options.structure,
        "base": fit.options.base,
        "runs": list(data.runs),
        "lines": data.count,
        "lines_dropped": data.dropped,
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


def principal_axes_json(fit: KDFit) -> dict[str, Any] | None:
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
    value, sd = height
    return {
        "height_mm": 1e3 * value,
        "height_sd_mm": 1e3 * sd,
        "coupling_si": fit.coupling,
        "coupling_sd_si": np.sqrt(np.diag(fit.coupling_covariance)).reshape(3, 3),
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


def ring_of(fit: KDFit) -> RingTest | None:
    """Return the comparison with a uniform ring around the footplate; None without an outline."""
    n = len(fit.dof)
    places = [0, n * (n + 1) // 2]
    middle = np.sqrt(fit.found.data.freq_hz.min() * fit.found.data.freq_hz.max())
    factor = complex(fit.law.factor(np.array([2.0 * np.pi * middle]))[0])
    covariance = fit.covariance[np.ix_(places, places)]
    piston = fit.values[places]
    test = ring_test(fit.stiffness, piston, factor, fit.footplate_outline_mm, covariance)
    if test is None or fit.gap_mm is None:
        return test
    return replace(test, gap_m=Value(1e-3 * fit.gap_mm[0], 1e-3 * fit.gap_mm[1]))


def _ring(fit: KDFit) -> dict[str, Any] | None:
    ring = ring_of(fit)
    if ring is None:
        return None
    product = ring.shear_times_thickness
    return {
        "rim_length_mm": 1e3 * ring.rim_length_m,
        "shear_modulus_times_thickness_over_width_pa": _value(ring.shear_pa),
        "shear_modulus_times_thickness_pa_m": None if product is None else _value(product),
        "loss_factor": _value(ring.loss_factor),
        "rocking_measured_over_ring": dict(zip(("near_x", "near_z"), ring.rocking_ratio, strict=True)),
        "thickness_over_width_for_published_moduli": list(ring.thickness_over_width),
    }


def _value(value: Value) -> dict[str, float | None]:
    return {"value": finite_or_none(value.value), "sd": finite_or_none(value.sd)}


def _unknowns(fit: KDFit) -> list[dict[str, Any]]:
    """Return the further estimated unknowns."""
    return [
        {
            "name": unknown.name,
            "value": value,
            "sd": sd,
            "unit": unknown.unit,
            "asked_for": unknown.name in fit.options.unknowns,
        }
        for unknown, value, sd in fit.unknowns
    ]


def _causes(fit: KDFit) -> dict[str, Any] | None:
    """Return the search for causes: scores, refits with their odds, the best explanation."""
    search = fit.solution.search
    if not search.scores:
        return None
    best = search.best
    return {
        "searched": search.searched,
        "best": None if best is None else best.name,
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
                "found_from": found_from(score.sd, score.unknown.sd, score.unknown.chance),
            }
            for score in search.scores
        ],
    }


def found_from(sd: float, prior_sd: float, chance: float) -> float:
    """Return the size from which an unknown is found in four of five measurements, in its unit.

    Its log odds are above LOOK_ALIKE for |estimate| > sd sqrt(2 ln(...)); 0.84 sd more give 80 %.
    """
    wide = sd**2 + prior_sd**2
    needed = np.log(wide / sd**2) - 2.0 * np.log(chance) + 2.0 * LOOK_ALIKE
    return float(np.sqrt(needed / (1.0 / sd**2 - 1.0 / wide)) + 0.84 * sd)


def _fit(fit: KDFit) -> dict[str, Any]:
    found, book = fit.found, fit.solution.textbook
    bias = np.zeros(len(fit.parameters)) if book is None else book.bias * entry_scale(found)
    return {
        "chi2": found.chi2,
        "n_dof": found.n_dof,
        "chi2_per_dof": found.chi2 / found.n_dof if found.n_dof > 0 else None,
        "p_value": found.p_value,
        "iterations": found.evaluations,
        "converged": found.converged,
        "active_constraints": list(active_constraints(fit)),
        "noise_covariance_scaled_by": max(1.0, found.level),
        "estimated_bias_si": _named(fit, bias),
    }


def _bands(fit: KDFit) -> dict[str, Any] | None:
    bands = fit.solution.bands
    if bands is None:
        return None
    content: dict[str, Any] = {"bands_hz": bands.ends_hz, "lines": bands.lines}
    for place, name in enumerate(("stiffness", "damping")):
        content |= {f"{name}_factor": bands.factors[place], f"{name}_factor_sd": bands.sd[place]}
    relative = "K and D of the whole band; the factors' means, weighted by information, are 1"
    return {
        **content,
        "relative_to": relative,
        "chi2": bands.chi2,
        "n_dof": bands.n_dof,
        "p_value": bands.p_value,
    }


def _identifiability(fit: KDFit) -> dict[str, Any]:
    return {
        "worst_combinations": [
            {"relative_sd": finite_or_none(sd), "entries": parts} for sd, parts in fit.combinations[:3]
        ],
        "cramer_rao_bound_si": _named(fit, fit.bound),
        "relative_to": "sqrt(Xii Xjj) for entry (i, j) of X = K or D",
    }


def shown_sources(budget: Mapping[str, Any]) -> dict[str, str]:
    """Return the words for the sources of a budget."""
    from stapeskit.records.mass_matrix import source_words

    words = {
        "channel_noise": "channel noise",
        "registration": "registration of the vibrometer",
        "plate_frame": "plate frame in the scan",
        "footplate_frame": "footplate frame (motion and mass together)",
        "position": "point positions",
        "laser_gain": "gain of the lasers",
        "laser_phase": "phase of the lasers",
        "laser_delay": "delay of the lasers",
        "inplane_stiffness": "stiffness in the plane of the ligament",
        "ligament_plane": "height and tilt of the ligament's plane (second order)",
        "model_error": "what the model may lack, and weak data",
    }
    return {
        source: words.get(source)
        or (source_words(source[5:]) if source.startswith("mass.") else source.replace("_", " "))
        for source in budget
    }
