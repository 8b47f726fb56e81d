"""The laws of a cohort: which quantities of the ligament follow which of the stapes, and how surely."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.cohort.components import Components, independent_parameters
from pipeline.cohort.ears import Ear
from pipeline.cohort.law import Law, fit_law
from pipeline.cohort.logarithms import LogTable, log_table
from pipeline.cohort.many_tests import false_discovery
from pipeline.cohort.prediction import Prediction, Predictor, left_out_errors
from pipeline.errors import PipelineError
from stapeskit.faults import Fault, raise_all
from stapeskit.warnings import Notice

Array = NDArray[np.float64]
SCHEMA = "stapeskit.cohort/1"

# Planned before any data: what a ligament of one material and one shape would follow. All others are
# exploratory.
PRIMARY = (
    ("K11", "mass_kg"),
    ("K22", "mass_kg"),
    ("K33", "mass_kg"),
    ("D11", "mass_kg"),
    ("K11", "footplate_length_m"),
    ("K11", "gap_m"),
)
# A law has four unknowns besides the mean of x: with five ears one degree of freedom more than none is left.
LEAST_EARS = 5


@dataclass(frozen=True)
class CohortLaw:
    """One law of a cohort.

    Attributes
    ----------
    response, predictor : str
    law : Law
    family : str
        ``primary`` or ``exploratory``.
    q_value : float
        False discovery rate within the family.
    prediction_error : float
        Root mean square of ln y less its prediction from the ears of all other persons.
    """

    response: str
    predictor: str
    law: Law
    family: str
    prediction_error: float
    q_value: float = float("nan")

    def as_json(self) -> dict[str, Any]:
        """Return the form of cohort.json; open ends of intervals are null."""
        law = self.law
        return {
            "response": self.response,
            "predictor": self.predictor,
            "family": self.family,
            "exponent": law.exponent,
            "exponent_interval_95": [_number(end) for end in law.interval],
            "unbounded": law.unbounded,
            "p_value": law.p_value,
            "q_value": self.q_value,
            "intercept_log": law.intercept,
            "intrinsic_sd_log": law.sigma,
            "intrinsic_sd_log_interval_95": list(law.sigma_interval),
            "predictor_sd_log": law.tau,
            "reliability": law.reliability,
            "correlation_of_pairs": law.rho,
            "prediction_error_log": _number(self.prediction_error),
            "n": law.n,
        }


@dataclass(frozen=True, repr=False)
class CohortLaws:
    """Laws over many ears.

    Attributes
    ----------
    ears : tuple of Ear
        Those that are used.
    excluded : tuple of (str, str)
        Name and reason of the others.
    table : LogTable or None
        None when there are no ears.
    laws : tuple of CohortLaw
    components : Components or None
    notices : tuple of Notice
    """

    ears: tuple[Ear, ...]
    excluded: tuple[tuple[str, str], ...]
    table: LogTable | None
    laws: tuple[CohortLaw, ...]
    components: Components | None
    notices: tuple[Notice, ...]
    _predictors: dict[tuple[str, str], Predictor] = field(default_factory=dict, repr=False, compare=False)

    def law(self, response: str, predictor: str) -> CohortLaw:
        """Return a law, by whole names or their beginnings: ``law("K11", "mass")``.

        Raises
        ------
        PipelineError
            There is no such law.
        """
        if self.table is not None:
            try:
                names = self.table.full_name(response), self.table.full_name(predictor)
            except KeyError:
                names = (response, predictor)
            for one in self.laws:
                if (one.response, one.predictor) == names:
                    return one
        known = ", ".join(sorted({f"{one.response} ~ {one.predictor}" for one in self.laws})) or "none"
        raise PipelineError(Fault("the law", f"one of {known}", f"{response} ~ {predictor}"))

    def predict(self, mass: Mapping[str, Any], response: str = "K11", predictor: str = "mass") -> Prediction:
        """Predict the natural logarithm of a response of an ear from its CT alone.

        Parameters
        ----------
        mass : mapping
            Content of its mass.json.
        response, predictor : str

        Raises
        ------
        PipelineError
            There is no such law, or the scan lacks the predictor.
        """
        law = self.law(response, predictor)
        assert_table = self.table
        if assert_table is None:
            raise PipelineError(Fault("the cohort", "of at least five ears", "none"))
        key = (law.response, law.predictor)
        pairs, _ = assert_table.pairs(*key)
        if key not in self._predictors:
            self._predictors[key] = Predictor(pairs)
        alone = log_table([replace(self.ears[0], mass=mass)])
        column = alone.column(law.predictor)
        x, variance = float(alone.values[0, column]), float(alone.own[0, column, column])
        if not np.isfinite(x):
            raise PipelineError(Fault(law.predictor, "in mass.json", "none"))
        shared = float(np.mean(np.sum(pairs.shared[:, 1] ** 2, axis=1)))
        return self._predictors[key].predict(x, variance, shared)

    def tolerance(self, response: str, predictor: str = "mass") -> tuple[float, float]:
        """Return the 95 % range of ln of a response over ears of this population: "is this ear normal"."""
        law = self.law(response, predictor)
        if self.table is None:
            raise PipelineError(Fault("the cohort", "of at least five ears", "none"))
        return Predictor(self.table.pairs(law.response, law.predictor)[0]).tolerance()

    def as_json(self, provenance: Mapping[str, Any]) -> dict[str, Any]:
        """Return the content of cohort.json."""
        count = self.components
        return {
            "schema": SCHEMA,
            "ears": [ear.name for ear in self.ears],
            "excluded": [{"ear": name, "reason": reason} for name, reason in self.excluded],
            "laws": [one.as_json() for one in self.laws],
            "independent_parameters": None
            if count is None
            else {
                "estimate": count.estimate,
                "interval_95": list(count.interval),
                "sd_log": count.sd.tolist(),
                "loadings_log": count.loadings.tolist(),
            },
            "shared_errors": [] if self.table is None else list(self.table.sources),
            "warnings": [notice.as_json() for notice in self.notices],
            "provenance": dict(provenance),
        }


def study_ears(ears: Sequence[Ear], failed: Mapping[str, str] | None = None, mix: bool = False) -> CohortLaws:
    """Fit every law of response on predictor that the ears allow.

    Parameters
    ----------
    ears : sequence of Ear
    failed : mapping of str to str, optional
        Ears without a result, and why.
    mix : bool
        Put ears together that were fitted or prepared in different ways.

    Raises
    ------
    PipelineError
        The ears do not belong together: fits by different estimators or damping laws, other degrees of
        freedom, a cochlea open in some and closed in others, an ear twice. ``mix`` allows all but the last
        two.
    """
    faults = _not_together(ears, mix)
    raise_all(PipelineError, faults)
    excluded = tuple((failed or {}).items())
    if len(ears) < LEAST_EARS:
        text = (
            f"Laws need at least {LEAST_EARS} ears; there are {len(ears)}. The ears stand side by side only."
        )
        return CohortLaws(tuple(ears), excluded, None, (), None, (Notice("cohort_too_small", text),))
    table = log_table(ears)
    laws = [
        _law(table, response, predictor) for response in table.responses for predictor in table.predictors
    ]
    kept = [law for law in laws if law is not None]
    with_q: list[CohortLaw] = []
    for family in ("primary", "exploratory"):
        members = [law for law in kept if law.family == family]
        q_values = false_discovery(np.array([law.law.p_value for law in members]))
        with_q += [replace(law, q_value=float(q)) for law, q in zip(members, q_values, strict=True)]
    components = _components(table)
    return CohortLaws(
        tuple(ears), excluded, table, tuple(with_q), components, (*table.notices, *_doubts(with_q))
    )


def study_ears_or_say_why(ears: Sequence[Ear], failed: Mapping[str, str]) -> CohortLaws:
    """Fit every law, or return a cohort without laws and with the reason as its warning."""
    try:
        return study_ears(ears, failed)
    except PipelineError as fault:
        reason = str(fault).replace("\n", " ")
        return CohortLaws(
            tuple(ears),
            tuple(failed.items()),
            None,
            (),
            None,
            (Notice("cohort_mixed", f"No laws: {reason}"),),
        )


def _law(table: LogTable, response: str, predictor: str) -> CohortLaw | None:
    """Fit one law; None where too few ears have both quantities or the predictor is the same in all."""
    pairs, _ = table.pairs(response, predictor)
    if pairs.n < LEAST_EARS or float(np.ptp(pairs.x)) < 1e-9 or float(np.ptp(pairs.y)) < 1e-9:
        return None
    errors = left_out_errors(pairs)
    known = errors[np.isfinite(errors)]
    error = float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
    family = "primary" if (response, predictor) in PRIMARY else "exploratory"
    return CohortLaw(response, predictor, fit_law(pairs), family, error)


def _components(table: LogTable) -> Components | None:
    """Count the independent parameters among the responses of the ears that have all of them."""
    columns = [table.column(name) for name in table.responses if "principal" not in name]
    keep = np.all(np.isfinite(table.values[:, columns]), axis=1)
    if int(keep.sum()) < LEAST_EARS:
        return None
    values = table.values[keep][:, columns]
    own = table.own[keep][:, columns][:, :, columns]
    if float(np.min(np.ptp(values, axis=0))) < 1e-9:
        return None
    return independent_parameters(values, own)


def _not_together(ears: Sequence[Ear], mix: bool) -> list[Fault]:
    """List why ears are no cohort."""
    faults: list[Fault] = []
    folders = [ear.folder for ear in ears]
    twice = sorted({name for name in folders if folders.count(name) > 1})
    if twice:
        faults.append(Fault("an ear", "in a cohort once", f"{', '.join(twice)} twice", "", "Leave one out"))
    hashes = [_measurement(ear) for ear in ears]
    same = sorted({ear.name for ear, one in zip(ears, hashes, strict=True) if one and hashes.count(one) > 1})
    if same:
        faults.append(
            Fault("ears", "measured one by one", f"the same motion in {', '.join(same)}", "", "Leave one out")
        )
    checks: list[tuple[str, list[str]]] = [
        ("degrees of freedom", [",".join(ear.kd["dof"]) for ear in ears]),
    ]
    if not mix:
        checks += [
            ("estimator", [str(ear.kd["estimator"]) for ear in ears]),
            ("damping law", [str(ear.kd["model"].get("damping_law")) for ear in ears]),
            ("cochlea", [str(ear.about.get("cochlea", "")) for ear in ears]),
            ("incus", [str(ear.about.get("incus", "")) for ear in ears]),
        ]
    for what, values in checks:
        if len(set(values)) > 1:
            listed = ", ".join(
                f"{ear.name}: {value or 'not stated'}" for ear, value in zip(ears, values, strict=True)
            )
            step = "Make a cohort of each kind, or allow a mixed one"
            faults.append(Fault(f"the {what}", "the same in all ears of a cohort", listed, "", step))
    return faults


def _measurement(ear: Ear) -> str:
    inputs = (ear.kd.get("provenance") or {}).get("inputs") or {}
    return str((inputs.get("motion") or {}).get("hash") or "")


def _doubts(laws: Sequence[CohortLaw]) -> list[Notice]:
    """Return warnings about laws that the data cannot settle."""
    open_laws = [
        f"{one.response} ~ {one.predictor}" for one in laws if one.law.unbounded and one.family == "primary"
    ]
    if not open_laws:
        return []
    text = (
        f"The exponents of {', '.join(open_laws)} are unbounded: the predictor is not resolved, its spread "
        "over these ears is not surely larger than its error."
    )
    return [Notice("predictor_not_resolved", text)]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
