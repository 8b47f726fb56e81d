"""The command dof2kd."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NoReturn

from fitting.estimators import ESTIMATORS
from fitting.model.laws import LAWS
from fitting.plan.plan_example import PLAN_EXAMPLE as _PLAN_EXAMPLE
from stapeskit.command import Outcome, Parser, numbers, run
from stapeskit.faults import StapeskitError

_EPILOG = """DOF: dof.csv or dof.h5 of points2dof. M.csv: square, SI, no header, order of --dof.
Writes kd.json and kd.html (named after --out). Example:
  dof2kd dof.csv --mass stapes_mass/mass.json --band 400,5000 --exclude 45-55

Before measuring: dof2kd --plan plan.toml tells the standard deviations to expect of K, D and the modes, and
what another direction, a wider band, more lines or less noise would bring (plan.json and plan.html, named
after --out).
Every key has a default; plan.toml, e.g.:
"""


def _range(text: str) -> tuple[float, float]:
    parts = text.replace(",", "-").split("-")
    try:
        low, high = (float(part) for part in parts)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"the range must be two frequencies in Hz as F1-F2; got {text}. Write for example --exclude 45-55"
        ) from None
    return low, high


def _refits(text: str) -> int:
    try:
        count = int(text)
    except ValueError:
        count = -1
    if count != 0 and not 20 <= count <= 1_000_000:
        raise argparse.ArgumentTypeError(
            f"the number of refits must be a whole number from 20 to 1000000, or 0; got {text}. "
            "Write for example --monte-carlo 1000"
        )
    return count


def _bound(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name.strip(), float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"the bound must be an entry and a number in SI, as K11=100; got {text}. "
            "Write for example --lower K11=100 --upper D22=5e-8"
        ) from None


_OF_FITS = (
    "structure", "base", "dof", "estimator", "robust", "damping", "inplane", "constraint", "lower", "upper",
    "band", "exclude", "bands", "monte_carlo",
)  # fmt: skip


def parser() -> Parser:
    """Return the parser of the command."""
    made = Parser(
        "dof2kd",
        "Stiffness and damping from rigid-body motion and mass matrix.",
        _EPILOG + _PLAN_EXAMPLE,
    )
    made.add_argument("motion", type=Path, nargs="?", metavar="DOF", help="dof.csv or dof.h5")
    made.add_argument("--mass", type=Path, metavar="FILE", help="mass.json of ct2mass, or M.csv")
    made.add_argument(
        "--plan", type=Path, metavar="FILE.toml", help="a measurement to be made: tell what it can reach"
    )
    made.add_argument("--structure", default="stapes", metavar="BODY", help="the moving body (stapes)")
    made.add_argument("--base", default="base", metavar="BODY", help="the excited body (base)")
    made.add_argument(
        "--dof",
        default="y,alpha,gamma",
        metavar="LIST",
        help="degrees of freedom of the model (y,alpha,gamma)",
    )
    made.add_argument(
        "--estimator",
        default="ml",
        choices=tuple(ESTIMATORS),
        help="; ".join(f"{name}: {summary}" for name, summary in ESTIMATORS.items()),
    )
    made.add_argument(
        "--robust", default="none", choices=("none", "t4"), help="t4: outlying lines lose weight (ml)"
    )
    made.add_argument(
        "--damping",
        default="viscous",
        choices=(*LAWS, "compare"),
        help="; ".join(f"{name}: {summary}" for name, summary in LAWS.items()) + "; compare: all of them",
    )
    made.add_argument(
        "--inplane",
        default="auto",
        choices=("auto", "load", "ignore"),
        help="measured motion outside --dof as a known inertial load (auto: when significant)",
    )
    made.add_argument(
        "--constraint",
        default="eigenvalues",
        choices=("eigenvalues", "psd"),
        help="of the constrained estimator: the paper's stability, or K and D positive semidefinite",
    )
    for option, word in (("--lower", "lower"), ("--upper", "upper")):
        made.add_argument(
            option,
            type=_bound,
            action="append",
            default=None,
            metavar="ENTRY=VALUE",
            help=f"{word} bound of an entry in SI, e.g. K11=100 (constrained)",
        )
    made.add_argument(
        "--band", type=numbers(2, "--band"), default=None, metavar="F1,F2", help="fit these frequencies, Hz"
    )
    made.add_argument(
        "--exclude", type=_range, action="append", default=None, metavar="F1-F2", help="leave out, Hz"
    )
    made.add_argument(
        "--bands",
        type=int,
        default=5,
        metavar="N",
        help="compare K and D in N parts of the band with those of the whole (default 5; 0: do not)",
    )
    made.add_argument(
        "--monte-carlo",
        type=_refits,
        default=0,
        metavar="N",
        help="check the intervals by N refits of simulated repetitions, e.g. 10000 (about 10 s)",
    )
    made.add_argument(
        "--out", type=Path, default=None, metavar="FILE.json", help="kd.json; plan.json with --plan"
    )
    made.add_force()
    made.add_config()
    return made


def _work(arguments: list[str]) -> tuple[argparse.Namespace, Outcome]:
    made = parser()
    options = made.parse(arguments)
    if options.plan is not None:
        return options, _plan(options)
    if options.motion is None or options.mass is None:
        missing = [
            name for name, value in (("DOF", options.motion), ("--mass", options.mass)) if value is None
        ]
        made.error(f"the following arguments are required: {', '.join(missing)}")
    from fitting.dof2kd import dof2kd
    from fitting.kd_fit import KDOptions
    from fitting.report.sections import summary_rows
    from stapeskit.spatial import parse_dof

    dof = parse_dof(options.dof)
    _check_order(options, dof)
    chosen = KDOptions(
        dof=dof,
        structure=options.structure,
        base=options.base,
        estimator=options.estimator,
        robust=options.robust,
        damping=options.damping,
        inplane=options.inplane,
        band_hz=options.band,
        exclude_hz=tuple(options.exclude or ()),
        constraint=options.constraint,
        lower=dict(options.lower or ()),
        upper=dict(options.upper or ()),
        bands=options.bands,
    )
    done = dof2kd(
        options.motion,
        options.mass,
        chosen,
        options.out or Path("kd.json"),
        options.monte_carlo,
        force=options.force,
        config=options.config,
    )
    return options, Outcome(
        "stiffness and damping", summary_rows(done.fit), done.fit.notices, done.files, dict(done.content)
    )


def _check_order(options: argparse.Namespace, dof: tuple[str, ...]) -> None:
    """Refuse --dof in another order than the fixed one where entries are counted by it."""
    given = [part.strip().lower() for part in options.dof.split(",") if part.strip()]
    if options.dof.strip().lower() == "all" or given == list(dof):
        return
    counted = [option for option in ("lower", "upper") if getattr(options, option)]
    if options.mass.suffix.lower() != ".json" or counted:
        raise StapeskitError(
            "--dof must be in the order x,y,z,alpha,beta,gamma where a plain mass matrix or bounds "
            f"count by it; got {','.join(given)}. Write --dof {','.join(dof)} and order rows and columns so."
        )


def _plan(options: argparse.Namespace) -> Outcome:
    """Tell what a planned measurement can reach."""
    if options.motion is not None or options.mass is not None:
        raise StapeskitError(
            "--plan must be given without DOF and --mass; got both. The plan names its mass itself "
            '(mass = "mass.json").'
        )
    ignored = [
        f"--{name.replace('_', '-')}"
        for name in _OF_FITS
        if getattr(options, name) != parser().get_default(name)
    ]
    if ignored:
        raise StapeskitError(
            f"--plan must be given without options of a fit; got {', '.join(ignored)}. Put dof and band_hz "
            "into the plan and leave the others out."
        )
    from fitting.dof2kd import plan2kd
    from fitting.plan.plan import summary_rows

    found, content, files = plan2kd(
        options.plan, options.out or Path("plan.json"), force=options.force, config=options.config
    )
    return Outcome("what the plan can reach", summary_rows(found), found.notices, list(files), content)


def main() -> NoReturn:
    """Run the command and leave with its exit code."""
    run("dof2kd", _work)
