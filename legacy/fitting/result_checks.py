"""Warnings about a result: stability, passivity, identifiability, misfit, attenuation, plausibility."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from legacy.fitting.options import CORRECT
from legacy.fitting.uncertainty.identifiability import relative_sizes
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.faults import list_some
from legacy.stapeskit.option_names import named
from legacy.stapeskit.page.quantities import MASS
from legacy.stapeskit.warnings import Notice

if TYPE_CHECKING:
    from legacy.fitting.kd_fit import KDFit

# Published stiffness of the human annular ligament in piston direction, N/m.
PISTON_RANGE = (120.0, 3200.0)
# Masses of human stapedes; outside the wider range a mass is one in another unit, or of something else.
_HUMAN_KG = (2e-6, 4.5e-6)
_MASS_RANGE_KG = (0.5e-6, 10e-6)
# Half length and half width of a human footplate, mm: radii of gyration about x, z lie below its size.
_GYRATION_RANGE_MM = (0.2, 4.0)
_MISFIT = 1e-4
_FALSE_OUTLIERS = 0.01
_BIASED = 0.02


def result_warnings(fit: KDFit) -> list[Notice]:
    """Return every warning that a result deserves."""
    notices = [*physics(fit), *fit.identifiability.notices(), *fit.inplane.notices(), *_fit_quality(fit)]
    local = [] if fit.frequency is None else fit.frequency.notices()
    return [*notices, *local, *_bias(fit), *_inputs(fit), *plausibility(fit)]


def physics(fit: KDFit) -> list[Notice]:
    """Return warnings about stability and passivity."""
    notices = []
    if not fit.modes.stable:
        notices.append(
            Notice(
                "unstable",
                f"The model is unstable: an eigenvalue has the real part {fit.modes.max_real_1_s:+.3g} 1/s. "
                f"No passive ligament does this; use {named('estimator')} ml.",
            )
        )
    stiffness, damping = fit.passive
    wrong = [name for name, good in (("K", stiffness), ("D", damping)) if not good]
    if wrong:
        notices.append(
            Notice(
                "not_passive",
                f"{' and '.join(wrong)} {'is' if len(wrong) == 1 else 'are'} not positive semidefinite: "
                "the model can give off energy that it never took in.",
            )
        )
    if fit.estimate.active:
        notices.append(
            Notice(
                "constraint_active",
                f"The estimate is held back by {', '.join(fit.estimate.active)}; the data alone would lead "
                "elsewhere, and intervals near the constraint are approximate.",
            )
        )
    return notices


def _fit_quality(fit: KDFit) -> list[Notice]:
    from scipy.special import chdtr, chdtrc

    notices = []
    if not fit.estimate.converged:
        notices.append(
            Notice("not_converged", "The estimator stopped before it settled; do not trust the result.")
        )
    if fit.n_dof > 0 and fit.options.robust == "none":
        ratio = fit.chi2 / fit.n_dof
        joint = fit.chi2 if fit.joint_chi2 is None else fit.joint_chi2
        if chdtrc(fit.n_dof, joint) < _MISFIT:
            notices.append(
                Notice(
                    "misfit",
                    "Residuals exceed noise and shared errors: chi2 per degree of freedom is "
                    f"{joint / fit.n_dof:.3g}. Noise may be "
                    "understated, or the model (damping law, neglected motion, mass matrix) is wrong"
                    + (
                        f"; channel noise was widened by {np.sqrt(fit.budget.widened):.3g}, which does not "
                        "cover a wrong model."
                        if fit.budget.widened > 1.0
                        else "."
                    ),
                )
            )
        elif chdtr(fit.n_dof, fit.chi2) < _MISFIT:
            notices.append(
                Notice(
                    "noise_overstated",
                    f"Residuals are smaller than their stated noise: chi2 per degree of "
                    f"freedom is {ratio:.3g}.",
                )
            )
    far = outlying(fit)
    if len(far):
        listed = list_some((f"{freq:.6g}" for freq in far), 5)
        text = f"{len(far)} of {len(fit.observation.freq_hz)} lines lie farther off than noise brings them"
        notices.append(Notice("outliers", f"{text} (at {listed} Hz); they were given little weight."))
    return notices


def cause_notices(fit: KDFit) -> list[Notice]:
    """Return warnings about a cause that the data support, and about a mass of fluid."""
    from legacy.fitting.causes.catalogue import shown_unit, title_of, unit_of
    from legacy.fitting.causes.diagnosis import largest_effect

    notices = [] if fit.fluid is None else list(fit.fluid.notices)
    cause = None if fit.diagnosis is None else fit.diagnosis.named
    if cause is None or fit.diagnosis is None:
        return notices
    unit = shown_unit(unit_of(cause.name))
    size = f"{unit.of(cause.size):.3g} ± {unit.text(cause.sd, '.1g')}".rstrip()
    size = f" of {size}" if cause.sd > 0.0 else ""
    place, change = largest_effect(cause.effect, fit.stiffness, fit.damping)
    others = [title_of(name) for name in fit.diagnosis.look_alikes]
    text = (
        f"The data speak for {title_of(cause.name)} ({cause.name}){size}; chi2 falls by {cause.fall:.0f}, "
        f"over {fit.diagnosis.threshold:.1f}. With it {fit.parameters[place]} changes by "
        f"{100.0 * change:+.2g} % of sqrt(Xii Xjj)."
    )
    if others:
        text += f" The data hardly tell it from {' or '.join(others)}."
    text += " K and D are without it, but their intervals include that change."
    text += f" {named('correct')} {cause.name} estimates and removes it." if cause.name in CORRECT else ""
    if cause.p_value < _MISFIT:
        text += " It does not explain the whole misfit."
    if any(notice.code == "motion_without_h5" for notice in fit.notices):
        text += (
            " The motion was read without the correlations of its noise, on which this depends: fit with its "
            ".h5 file before you believe it."
        )
    law = cause.name.removeprefix("law_")
    text += f" Use {named('damping')} {law}, or compare." if law != cause.name else ""
    return [*notices, Notice("cause_found", text)]


def outlying(fit: KDFit) -> Array:
    """Return the frequencies (Hz) of lines that noise as that of most lines makes in 1 % of fits.

    Notes
    -----
    A robust weight is 4 s / (4 s + 2 d) with the distance d of the line; over its median, 2 d is judged by
    the chi2 distribution with two degrees of freedom an equation.
    """
    from scipy.special import chdtri

    weights = fit.estimate.weights
    if weights is None:
        return np.empty(0)
    distance = 1.0 / np.maximum(weights, 1e-300) - 1.0
    degrees = 2 * len(fit.dof)
    usual = float(np.median(distance)) / float(chdtri(degrees, 0.5))
    limit = usual * float(chdtri(degrees, _FALSE_OUTLIERS / len(weights)))
    return fit.observation.freq_hz[distance > limit]


def _bias(fit: KDFit) -> list[Notice]:
    bias = fit.budget.bias
    if not np.any(bias):
        return []
    sizes = relative_sizes(np.concatenate([fit.estimate.parameters]), len(fit.dof))
    relative = bias / fit.problem.units / sizes
    worst = int(np.argmax(np.abs(relative)))
    if abs(relative[worst]) < _BIASED:
        return []
    return [
        Notice(
            "attenuation_bias",
            f"{fit.options.estimator} is biased by the noise of its regressor however many lines there are: "
            f"{fit.parameters[worst]} by about {100.0 * relative[worst]:+.2g} % of sqrt(Xii Xjj). "
            f"{named('estimator')} ml is not.",
        )
    ]


def _inputs(fit: KDFit) -> list[Notice]:
    notices = []
    if fit.observation.dropped:
        notices.append(
            Notice(
                "lines_dropped", f"{fit.observation.dropped} lines were left out: a value is missing there."
            )
        )
    if not fit.problem.inertia.contributions:
        notices.append(
            Notice(
                "mass_uncertainty_not_given",
                "The mass matrix came without an uncertainty; the intervals of K and D do not include it.",
            )
        )
    return notices


def plausibility(fit: KDFit) -> list[Notice]:
    """Compare with the literature: mass, piston stiffness, radii of gyration."""
    notices = [*_mass(fit)]
    if "y" in fit.dof:
        place = fit.dof.index("y")
        value = float(fit.stiffness[place, place])
        if not PISTON_RANGE[0] <= value <= PISTON_RANGE[1]:
            notices.append(
                Notice(
                    "implausible_stiffness",
                    f"The piston stiffness {value:.4g} N/m lies outside the published {PISTON_RANGE[0]:g} to "
                    f"{PISTON_RANGE[1]:g} N/m of human annular ligaments.",
                )
            )
        for name in ("alpha", "gamma"):
            if name in fit.dof:
                other = fit.dof.index(name)
                radius = 1e3 * float(np.sqrt(fit.mass[other, other] / fit.mass[place, place]))
                if not _GYRATION_RANGE_MM[0] <= radius <= _GYRATION_RANGE_MM[1]:
                    notices.append(
                        Notice(
                            "implausible_inertia",
                            f"The radius of gyration of {name}, {radius:.3g} mm, does not fit a human "
                            "stapes; "
                            "check the units of M.",
                        )
                    )
    return notices


def _mass(fit: KDFit) -> list[Notice]:
    """Compare the mass of a body that is called stapes with that of human ones."""
    moving = [place for place, name in enumerate(fit.dof) if name in "xyz"]
    if not moving or "stapes" not in fit.options.structure.lower():
        return []
    mass_kg = float(fit.mass[moving[0], moving[0]])
    if _MASS_RANGE_KG[0] <= mass_kg <= _MASS_RANGE_KG[1]:
        return []
    return [
        Notice(
            "implausible_mass",
            f"The mass matrix gives the {fit.options.structure} {MASS.text(mass_kg, '.3g')}; human ones "
            f"weigh {MASS.of(_HUMAN_KG[0]):g} to {MASS.text(_HUMAN_KG[1])}. K and D grow in proportion to "
            "it: check that M is in SI units (kg, kg m, kg m2), or name the body by "
            f"{named('structure')} if it is no stapes.",
        )
    ]
