"""The options of ``dof2kd``, each declared once."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from stapeskit.faults import Fault, raise_all
from stapeskit.option_types import (
    CountOrZero,
    DofList,
    Flag,
    Range,
    Ranges,
    ReadFile,
    Table,
    Text,
    Words,
    one_of,
    output_file,
)
from stapeskit.options import Opt, Options, Rule

DAMPING = {
    "viscous": "K + i w D",
    "hysteretic": "K + i D",
    "fractional": "K + (i w)^{a:.4g} D",
    "relaxation": "K + i w D / (1 + i w {a:.3g} s)",
}
"""Formula of each law of `laws.LAWS`, with {a} for an unknown."""

UNKNOWN_NAMES = (
    *("delay", "phase", "gain", "fluid", "head_mass", "centre_x", "centre_y", "centre_z", "inertia"),
    *("mirrored", "drift", "nonlinear"),
)
"""Names of the entries of `unknowns.UNKNOWNS`, which a user may free or fix."""

COMPARE = "compare"
LOADED, IGNORE = "load", "ignore"

JsonFile = Annotated[Path, output_file(".json")]

_BOUNDED = "estimator constrained"
_NAMES = ", ".join(UNKNOWN_NAMES)
_LAW_HELP = "; ".join(f"{name}: {form.format(a=0.5)}" for name, form in DAMPING.items())


class KDOptions(Options):
    """Choices of a fit; every field is an option of ``dof2kd`` and a key of ``[fit]``."""

    table: ClassVar[str] = "fit"
    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(
            lambda v: v.robust != "none" and v.estimator != "ml",
            Fault("--robust", "none unless --estimator is ml", "t4", "", "Leave one of the two out"),
        ),
        Rule(
            lambda v: (v.lower or v.upper) and v.estimator != "constrained",
            Fault("--lower and --upper", "left out unless --estimator is constrained", "bounds"),
        ),
        Rule(
            lambda v: v.unknowns and v.estimator != "ml",
            Fault("--unknowns", "left out unless --estimator is ml", "names", "", "Leave one of the two out"),
        ),
    )

    dof: Annotated[
        DofList, Opt("degrees of freedom of the model", example=["y", "alpha", "gamma"], recommended=True)
    ] = (
        "y",
        "alpha",
        "gamma",
    )
    structure: Annotated[Text, Opt("the moving body")] = "stapes"
    base: Annotated[Text, Opt("the excited body")] = "base"
    estimator: Annotated[
        Literal["ml", "pinv", "constrained"],
        Opt(
            "ml: maximum likelihood, errors in all variables; pinv: least squares (paper, Eq. 5); "
            "constrained: with signs, bounds, stability",
            recommended=True,
        ),
    ] = "ml"
    robust: Annotated[Literal["none", "t4"], Opt("t4: little weight for outlying lines (Student's t)")] = (
        "none"
    )
    damping: Annotated[
        str,
        one_of((*DAMPING, COMPARE)),
        Opt(f"{_LAW_HELP}; both 0.5 stand for a number that is estimated; compare: all of them"),
    ] = "viscous"
    inplane: Annotated[
        Literal["auto", "load", "ignore"],
        Opt(
            "measured motion outside --dof; auto: plane of the ligament, estimated with K and D, where "
            "motion and mass have six degrees of freedom, else load; load: known inertial load"
            "; ignore: left out"
        ),
    ] = "auto"
    unknowns: Annotated[
        Words,
        Opt(
            f"estimated with K and D whatever the data say: {_NAMES}; name=VALUE fixes one; "
            "none: nothing is added by evidence",
            example=["fluid"],
        ),
    ] = ()
    band_hz: Annotated[Range | None, Opt("fit these frequencies only, Hz", example=[400, 5000])] = None
    exclude_hz: Annotated[
        Ranges, Opt("leave these frequencies out, Hz", example=[[49, 51], [990, 1010]], repeats=True)
    ] = ()
    mass_sign: Annotated[
        Literal["assumed", "tensor", "positive"],
        Opt(
            "products of inertia in a plain M.csv; tensor: elements of the inertia tensor; positive: + "
            "integral x z dm; assumed: tensor, with a warning"
        ),
    ] = "assumed"
    monte_carlo: Annotated[
        CountOrZero, Opt("check the intervals by N simulated repetitions", example=200)
    ] = 0
    lower: Annotated[
        Table | None, Opt("lower bounds of entries, SI, in a file", _BOUNDED, {"K11": 100.0})
    ] = None
    upper: Annotated[
        Table | None, Opt("upper bounds of entries, SI, in a file", _BOUNDED, {"K11": 5000.0})
    ] = None

    @classmethod
    def read(
        cls, values: Mapping[str, Any], where: str, called: Mapping[str, str], folder: Path | None = None
    ) -> Self:
        """Check values by key, then bounds and names of unknowns."""
        made = super().read(values, where, called, folder)
        raise_all([*made._faults_of_bounds(), *made._faults_of_unknowns()])
        return made

    @property
    def freed(self) -> tuple[str, ...]:
        """Unknowns that are estimated whatever the data say."""
        return tuple(name for name in self.unknowns if "=" not in name and name != "none")

    @property
    def fixed(self) -> dict[str, float]:
        """Unknowns with the value at which they are fixed, in their unit."""
        pairs = (name.split("=") for name in self.unknowns if "=" in name)
        return {name.strip(): float(value) for name, value in pairs}

    @property
    def evidence(self) -> bool:
        """Whether an unknown may enter the model because the data call for it."""
        return "none" not in self.unknowns

    def _faults_of_unknowns(self) -> list[Fault]:
        faults = []
        for given in self.unknowns:
            name, _, value = given.partition("=")
            if name.strip() not in (*UNKNOWN_NAMES, "none") or (value and name == "none"):
                faults.append(Fault("--unknowns", f"names out of {_NAMES}, or none", given))
            elif value and not _is_number(value):
                faults.append(Fault(f"--unknowns {name}", "a number behind the sign =", value))
        return faults

    def _faults_of_bounds(self) -> list[Fault]:
        """Check the bounds against the entries that there are, and against each other."""
        triangle = list(itertools.combinations_with_replacement(range(1, len(self.dof) + 1), 2))
        entries = [f"{letter}{i}{j}" for letter in "KD" for i, j in triangle]
        lower, upper, faults = self.lower or {}, self.upper or {}, list[Fault]()
        for flag, bounds in (("--lower", lower), ("--upper", upper)):
            for name, value in bounds.items():
                if name not in entries:
                    step = "Count rows and columns in the order of --dof; K and D are symmetric"
                    faults.append(Fault(flag, f"an entry out of {', '.join(entries)}", name, "", step))
                elif isinstance(value, bool | str) or not math.isfinite(value):
                    faults.append(Fault(f"{flag} {name}", "a finite number in SI", value))
                elif bounds is upper and name[1] == name[2] and value <= 0.0:
                    faults.append(Fault(f"{flag} {name}", "positive, as a diagonal entry is", f"{value:g}"))
        for name in sorted(set(lower) & set(upper)):
            if not faults and lower[name] >= upper[name]:
                wanted, step = f"below {upper[name]:g}", f"Exchange the bounds of {name}"
                faults.append(Fault(f"--lower {name}", wanted, f"{lower[name]:g}", "", step))
        return faults


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


class KDFiles(Options):
    """What the command reads and writes."""

    rules: ClassVar[tuple[Rule, ...]] = (
        Rule(
            lambda v: v.motion and v.plan,
            Fault("DOF", "left out with --plan, which needs no measurement", "both"),
        ),
        Rule(
            lambda v: v.mass and v.plan,
            Fault("--mass", 'left out with --plan, which names its mass itself (mass = "mass.json")', "both"),
        ),
        Rule(
            lambda v: not v.motion and not v.plan,
            Fault("DOF", "given", "nothing", "", "points2dof writes dof.csv; dof2kd --help shows an example"),
        ),
    )

    motion: Annotated[
        ReadFile | None, Opt("motion, of points2dof", name="dof_file", positional=True, example="dof.csv")
    ] = None
    mass: Annotated[
        ReadFile | None,
        Opt("mass.json of ct2mass, or M.csv; default mass.json beside the motion", example="mass.json"),
    ] = None
    plan: Annotated[ReadFile | None, Opt("a planned measurement: what it can reach", example="plan.toml")] = (
        None
    )
    out: Annotated[JsonFile | None, Opt("default kd.json; plan.json with --plan")] = None
    export: Annotated[Words, Opt("further files: fe, prior", example=["fe", "prior"])] = ()
    force: Annotated[Flag, Opt("replace files that this command did not write; use another mass.json")] = (
        False
    )
    as_json: Annotated[Flag, Opt("print the whole result as JSON", name="json")] = False
    quiet: Annotated[Flag, Opt("print nothing but errors")] = False
