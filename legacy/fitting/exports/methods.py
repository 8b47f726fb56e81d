"""A paragraph on the methods for a paper, with the numbers of this fit."""

from __future__ import annotations

from legacy.fitting.causes.catalogue import title_of
from legacy.fitting.estimators import estimator
from legacy.fitting.kd_fit import KDFit


def content(fit: KDFit) -> bytes:
    """Return the paragraph."""
    from legacy.stapeskit.provenance import versions

    freq = fit.observation.freq_hz
    version = versions().get("stapeskit", "unknown")
    runs = len(fit.observation.runs)
    parts = [
        f"Stiffness K and damping D of the suspension in {', '.join(fit.dof)} about the footplate centre "
        f"were estimated from the motion of {fit.options.structure} and {fit.options.base} at {len(freq)} "
        f"lines between {freq.min():.0f} and {freq.max():.0f} Hz ({runs} {'run' if runs == 1 else 'runs'}) "
        f"by {estimator(fit.options.estimator).phrase}, with the dynamic stiffness "
        f"{fit.law.formula} (stapeskit {version}).",
    ]
    if fit.ligament is not None:
        height, sd = (1e3 * value for value in fit.ligament.height)
        parts.append(
            "The plane of the ligament was estimated with them, so that in-plane motion could couple with "
            f"rocking (height above the footplate centre {height:.2f} ± {sd:.2f} mm), and "
            f"{fit.ligament.lines.errors} errors common to all lines (registration, positions, frames, mass "
            "matrix) were unknowns of the same likelihood."
        )
        terms = [title_of(name) for name in fit.ligament.terms]
        if terms:
            parts.append(f"Estimated with them: {', '.join(terms)}.")
    elif fit.inplane.used:
        parts.append("The measured in-plane motion entered as a known inertial load.")
    parts.append(
        "Standard deviations hold channel noise"
        + (", with the errors of " if len(fit.budget.sources) > 1 else "")
        + ", ".join(name.replace("_", " ") for name in fit.budget.sources if name != "channel_noise")
        + f". Chi2 was {fit.chi2:.0f} for {fit.n_dof} degrees of freedom."
    )
    if len(fit.laws) > 1:
        names = ", ".join(law.law.name for law in fit.laws)
        parts.append(f"The damping law was chosen out of {names} by the criterion of Schwarz.")
    if fit.diagnosis is not None:
        named = fit.diagnosis.named
        outcome = "none was called for" if named is None else f"the data speak for {title_of(named.name)}"
        parts.append(
            f"{len(fit.diagnosis.tested)} errors of measurement and model were tested by scores; {outcome}."
        )
    return (" ".join(parts) + "\n").encode()
