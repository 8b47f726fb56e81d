"""The options of ``dof2kd``, each declared once."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from legacy.fitting.errors import FittingError
from legacy.fitting.estimators import CONSTRAINTS, ESTIMATORS, ROBUST, estimator
from legacy.fitting.export_formats import EXPORTS
from legacy.fitting.model.laws import LAWS
from legacy.stapeskit.faults import Fault, raise_all
from legacy.stapeskit.option_declaration import option
from legacy.stapeskit.option_kinds import (
    BOUNDS,
    DOF,
    FLAG,
    RANGE,
    RANGES,
    TEXT,
    VALUE_WITH_SD,
    choice,
    file,
    output,
    several,
    summaries,
    whole,
)
from legacy.stapeskit.option_rules import Rule, excludes
from legacy.stapeskit.option_values import WithSd
from legacy.stapeskit.options import OptionTable

COMPARE = "compare"
INPLANE = {
    "auto": "with ml the plane of the ligament is estimated with K and D; else a load where significant",
    "load": "a known inertial load",
    "ignore": "left out",
}
# Enough to see a trend over frequency, with 40 of 200 lines each.
USUAL_BANDS = 5
FLUID = {
    "auto": "taken where the data call for it, with a warning",
    "none": "never",
    "y": "always estimated, on the piston deflection",
}
CORRECT = ("delay", "phase", "gain", "fluid", "head_mass", "centre_x", "centre_y", "centre_z", "inertia")
COCHLEA = {
    "unknown": "",
    "open": "no fluid is expected",
    "drained": "no fluid is expected",
    "closed": "a mass of fluid is expected",
}

_BOUNDED = "estimators that take bounds"
_RULES = (
    Rule(
        lambda v: v.robust != "none" and v.robust not in estimator(v.estimator).robust,
        "{robust}",
        "none with this {estimator}",
        next_step="Leave one of the two out",
        shows="robust",
    ),
    Rule(
        lambda v: (v.lower or v.upper) and not estimator(v.estimator).bounded,
        "{lower} and {upper}",
        "left out unless {estimator} takes bounds",
        next_step="Choose an estimator that takes bounds, or leave them out",
        shows="estimator",
    ),
    Rule(
        lambda v: v.given("constraint") and not estimator(v.estimator).bounded,
        "{constraint}",
        "left out unless {estimator} takes bounds",
        next_step="Choose an estimator that takes bounds, or leave it out",
        shows="estimator",
    ),
    Rule(
        lambda v: (v.lower or v.upper) and v.dof.reordered,
        "{dof}",
        "in the order x,y,z,alpha,beta,gamma where bounds count by it",
        "another order",
        "Order the entries of the bounds so, too",
    ),
)


@dataclass(frozen=True)
class KDOptions(OptionTable):
    """Choices of a fit; every field is an option of ``dof2kd`` and a key of ``[fit]``.

    Raises
    ------
    FittingError
        A choice is unknown, or contradicts another.
    """

    table = "fit"
    title = "dof2kd"
    rules = _RULES
    error = FittingError

    dof: tuple[str, ...] = option(
        DOF,
        "degrees of freedom of the model",
        ("y", "alpha", "gamma"),
        example=["y", "alpha", "gamma"],
        recommended=True,
    )
    structure: str = option(TEXT, "the moving body", "stapes", metavar="BODY")
    base: str = option(TEXT, "the excited body", "base", metavar="BODY")
    estimator: str = option(choice(*ESTIMATORS), summaries(ESTIMATORS), "ml", recommended=True)
    robust: str = option(choice(*ROBUST), summaries(ROBUST), "none")
    damping: str = option(
        choice(*LAWS, COMPARE),
        f"damping law; {summaries(LAWS)}; compare: all of them",
        "viscous",
        metavar="LAW",
    )
    inplane: str = option(choice(*INPLANE), f"measured motion outside {{dof}}; {summaries(INPLANE)}", "auto")
    fluid: str = option(
        choice(*FLUID), f"mass of fluid that moves with the stapes; {summaries(FLUID)}", "auto"
    )
    cochlea: str = option(
        choice(*COCHLEA), "state of the cochlea, with which the mass of fluid is compared", "unknown"
    )
    correct: str = option(
        TEXT,
        f"causes to estimate with K and D and remove, separated by commas, out of {', '.join(CORRECT)}",
        "",
        metavar="NAMES",
        example="delay",
    )
    ligament_gap_mm: WithSd | None = option(
        VALUE_WITH_SD,
        "width of the ligament between the rims of footplate and window, mm; else that of mass.json",
        metavar="GAP[+-SD]",
        example="0.1+-0.02",
    )
    ligament_thickness_mm: WithSd | None = option(
        VALUE_WITH_SD,
        "its thickness along y, mm: with the width, the shear modulus follows from K11",
        metavar="T[+-SD]",
        example="0.25+-0.05",
    )
    band_hz: tuple[float, float] | None = option(
        RANGE, "fit these frequencies only, Hz", unit="hz", example=[400, 5000]
    )
    exclude_hz: tuple[tuple[float, float], ...] = option(
        RANGES,
        "leave these frequencies out, Hz; may be repeated",
        (),
        unit="hz",
        example=[[49, 51], [990, 1010]],
    )
    bands: int = option(
        whole("0, or 2 to 100 parts of the band", lambda n: n == 0 or 2 <= n <= 100),
        "compare K and D in so many parts of the band with those of the whole; 0: do not",
        USUAL_BANDS,
    )
    monte_carlo: int = option(
        whole("a whole number from 20 to 1000000, or 0", lambda n: n == 0 or 20 <= n <= 1_000_000),
        "check the intervals by so many refits of simulated repetitions, e.g. 10000 (about 10 s)",
        0,
    )
    constraint: str = option(choice(*CONSTRAINTS), summaries(CONSTRAINTS), "eigenvalues", group=_BOUNDED)
    lower: Mapping[str, float] = option(
        BOUNDS, "lower bound of an entry, SI; may be repeated", {}, group=_BOUNDED, example={"K11": 100.0}
    )
    upper: Mapping[str, float] = option(
        BOUNDS,
        "upper bound of an entry, SI; may be repeated",
        {},
        group=_BOUNDED,
        example={"K11": 5000.0},
    )
    profile: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        raise_all(FittingError, [*self._faults_of_bounds(), *self._faults_of_causes()])

    @property
    def causes(self) -> tuple[str, ...]:
        """Causes of the catalogue that are part of the model."""
        corrected = tuple(dict.fromkeys(part.strip() for part in self.correct.split(",") if part.strip()))
        return (*corrected, "fluid") if self.fluid == "y" and "fluid" not in corrected else corrected

    def _faults_of_causes(self) -> list[Fault]:
        """Check the names of causes, and that the model can hold them."""
        if not self.causes:
            return []
        unknown = [name for name in self.causes if name not in CORRECT]
        if unknown:
            return [Fault("{correct}", f"names out of {', '.join(CORRECT)}", ", ".join(unknown))]
        joint = estimator(self.estimator).likelihood and self.robust == "none" and self.inplane == "auto"
        if joint and tuple(self.dof) == ("y", "alpha", "gamma"):
            return []
        step = "Leave the other choices at their defaults, or leave causes and fluid out"
        wanted = "left out unless {estimator} is ml, {inplane} auto, {robust} none and {dof} y,alpha,gamma"
        return [Fault("{correct} and {fluid} y", wanted, ", ".join(self.causes), "", step)]

    @property
    def dof_reordered(self) -> bool:
        """Whether the degrees of freedom were given in another order than the fixed one."""
        return bool(getattr(self.dof, "reordered", False))

    def _faults_of_bounds(self) -> list[Fault]:
        """Check the bounds against the entries that there are, and against each other."""
        n = len(self.dof)
        triangle = list(itertools.combinations_with_replacement(range(1, n + 1), 2))
        entries = [f"{letter}{i}{j}" for letter in "KD" for i, j in triangle]
        faults = []
        for reference, bounds in (("{lower}", self.lower), ("{upper}", self.upper)):
            for name, value in bounds.items():
                if name not in entries:
                    step = "Count rows and columns in the order of {dof}; K and D are symmetric"
                    faults.append(Fault(reference, f"an entry out of {', '.join(entries)}", name, "", step))
                elif not math.isfinite(value):
                    faults.append(Fault(f"{reference} {name}", "a finite number in SI", value))
                elif bounds is self.upper and name[1] == name[2] and value <= 0.0:
                    step = "K and D have no negative diagonals; leave the bound out or give a positive one"
                    faults.append(Fault(f"{{upper}} {name}", "positive", f"{value:g}", "", step))
        for name in sorted(set(self.lower) & set(self.upper)):
            if self.lower[name] >= self.upper[name]:
                step = f"Swap {{lower}} and {{upper}} of {name}, or leave one out"
                expected = f"below {self.upper[name]:g}"
                faults.append(Fault(f"{{lower}} {name}", expected, f"{self.lower[name]:g}", "", step))
        return faults


@dataclass(frozen=True)
class KDFiles(OptionTable):
    """What the command reads and writes."""

    title = "dof2kd"
    rules = (
        Rule(
            lambda v: not v.plan and v.missing("motion", "mass"),
            "DOF and {mass}",
            "given",
            "one or none of them",
            "points2dof writes dof.csv, ct2mass writes mass.json; dof2kd --help shows an example",
        ),
        Rule(
            lambda v: v.mass and v.mass.suffix.lower() != ".json" and v.dof.reordered,
            "{dof}",
            "in the order x,y,z,alpha,beta,gamma where a plain mass matrix counts by it",
            "another order",
            "Order rows and columns of the matrix so, too",
        ),
        excludes("motion", "plan", "which needs no measurement"),
        excludes("mass", "plan", 'which names its mass itself (mass = "mass.json")'),
        Rule(
            lambda v: v.plan and v.given(*(set(KDOptions.__dataclass_fields__) - {"profile"})),
            "{plan}",
            "given without options of a fit",
            "some",
            "Put dof and band_hz into the plan and leave the others out",
        ),
    )
    error = FittingError

    motion: Path | None = option(
        file("dof.csv or dof.h5"), "motion, of points2dof", positional=True, metavar="DOF", example="dof.csv"
    )
    mass: Path | None = option(
        file("mass.json or M.csv", "Run ct2mass to make a mass.json"),
        "mass.json of ct2mass, or M.csv: M of {dof} or, better, of all six degrees of freedom",
        example="mass.json",
    )
    plan: Path | None = option(
        file("TOML file", "dof2kd --help shows an example"),
        "a planned measurement: what it can reach",
        metavar="FILE.toml",
        example="plan.toml",
    )
    out: Path | None = option(output(".json"), "default kd.json; plan.json with --plan", example="kd.json")
    export: tuple[str, ...] = option(
        several(*EXPORTS),
        f"further files beside OUT, separated by commas; {summaries(EXPORTS)}",
        (),
        example=["mat", "csv"],
    )
    force: bool = option(
        FLAG,
        "replace outputs that this command did not write, or that were edited",
        False,
    )
