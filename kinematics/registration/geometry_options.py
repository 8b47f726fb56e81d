"""Options of ``points2dof`` on where the vibrometer stood: surface points, and the geometry as an unknown."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stapeskit.faults import Fault

if TYPE_CHECKING:
    from kinematics.registration.geometry_model import GeometryPriors
    from stapeskit.command import Parser

_PRIORS = ("axes_sd", "beam_sd", "gain_sd")
_USED = {"axes_sd": 1.0, "beam_sd": 0.5, "gain_sd": 0.0}


def add_options(made: Parser) -> None:
    """Add the options to the command's parser."""
    made.add_argument(
        "--plate-points",
        type=Path,
        metavar="FILE",
        help="points measured on the plate ([name,] x_mm, y_mm, z_mm [, sd_mm] or a points file with a body "
        "plate): they are laid on plate.ply beside --mass, alone or with --fiducials as the first guess",
    )
    made.add_argument(
        "--bone-points",
        type=Path,
        metavar="FILE",
        help="points measured on the bone, in the same columns (body bone): did the sample move?",
    )
    made.add_argument(
        "--mirror-points",
        choices=("x", "y", "z"),
        help="turn this axis of all positions round, not of the beams: for left-handed coordinates beside "
        "right-handed directions",
    )
    made.add_argument(
        "--calibrate",
        action="store_true",
        help="estimate axes, laser directions and point positions together with the motion, within their sd",
    )
    made.add_argument(
        "--axes-sd",
        type=float,
        metavar="DEG",
        help="with --calibrate: sd of the turn between beams and positions (default 1)",
    )
    made.add_argument(
        "--beam-sd",
        type=float,
        metavar="DEG",
        help="with --calibrate: sd of the direction of each laser (default 0.5)",
    )
    made.add_argument(
        "--gain-sd",
        type=float,
        metavar="PERCENT",
        help="with --calibrate: sd of the gain of each laser (default 0: exact)",
    )


def faults(options: argparse.Namespace) -> list[Fault]:
    """List what contradicts itself among the options."""
    found = []
    for name in ("plate_points", "bone_points"):
        if getattr(options, name) is not None and options.mass is None:
            found.append(
                Fault(
                    f"--{name.replace('_', '-')}",
                    "given with --mass mass.json, whose folder holds the surfaces of the scan",
                    "no --mass",
                    next_step="Add --mass",
                )
            )
    if options.plate_points is not None and options.frame is not None:
        step = "Leave one of the two out"
        found.append(Fault("--frame", "left out beside --plate-points", options.frame, next_step=step))
    if not options.calibrate:
        found += [
            Fault(
                f"--{name.replace('_', '-')}",
                "given with --calibrate only",
                f"{getattr(options, name):g} alone",
                next_step="Add --calibrate",
            )
            for name in _PRIORS
            if getattr(options, name) is not None
        ]
    return found


def priors(
    calibrate: bool, axes_sd: float | None, beam_sd: float | None, gain_sd: float | None
) -> GeometryPriors | None:
    """Return the priors of a calibration, or None without one.

    Raises
    ------
    KinematicsError
        A number is out of range.
    """
    if not calibrate:
        return None
    from kinematics.registration.geometry_model import GeometryPriors

    given = {"axes_sd": axes_sd, "beam_sd": beam_sd, "gain_sd": gain_sd}
    a, b, c = (_USED[name] if value is None else value for name, value in given.items())
    return GeometryPriors(a, b, c)


def parameters(options: argparse.Namespace) -> dict[str, Any]:
    """Return the options for the provenance."""
    return {name: getattr(options, name) for name in ("mirror_points", "calibrate", *_PRIORS)}
