"""Make the sample study, or other ears: scan, vibrometer data, study file and the truth behind them.

    python -m sample_volumes.make_sample                       the sample study, always the same
    python -m sample_volumes.make_sample --out ear2 --seed 2 --ear gap_mm=0.06 bridges=2
    python -m sample_volumes.make_sample --out ear3 --ear incus_gap_mm=0.06 --scan mirror=z voxel_um=40
    python -m sample_volumes.make_sample --out ear4 --ear "stapes.family=foreign gutter" --experiment lines=60
    python -m sample_volumes.make_sample --out big --only scan --scan voxel_um=5 shape=[1024,1024,1024]

The settings are the fields of simulate.Ear, Scan and Experiment, with values as in TOML. Vibrometer data and
grey values are simulated on the geometry of a real stapes; nothing here is a measurement.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from simulate import Ear, Experiment, Scan, simulate_recording, simulate_study, write_recording

HERE = Path(__file__).parent
EXPORTS = ("uff", "fastscan", "mat", "wide")


def with_settings(value: Any, settings: Sequence[str], parser: argparse.ArgumentParser) -> Any:
    """Return a dataclass with fields set by ``name=value``, also ``name.name=value`` in a field of it."""
    for setting in settings:
        name, _, text = setting.partition("=")
        value = _set(value, name.split("."), _read(text), parser)
    return value


def _set(value: Any, names: list[str], wanted: Any, parser: argparse.ArgumentParser) -> Any:
    known = [field.name for field in fields(value)]
    if names[0] not in known:
        parser.error(
            f"a setting of {type(value).__name__} must be one of {', '.join(known)}; got {names[0]}."
        )
    inner = getattr(value, names[0])
    if len(names) > 1 and is_dataclass(inner):
        wanted = _set(inner, names[1:], wanted, parser)
    return replace(value, **{names[0]: wanted})


def _read(text: str) -> Any:
    """Return a TOML value, lists as tuples; what is none is a text."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
    return tuple(value) if isinstance(value, list) else value


def main(arguments: list[str] | None = None) -> None:
    """Make what the command line asks for."""
    parser = argparse.ArgumentParser(
        prog="make_sample", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=HERE, help="folder (the sample study's own)")
    parser.add_argument("--seed", type=int, default=1, help="pose, noise, positions and stated density")
    parser.add_argument("--only", choices=("scan", "ldv"), help="make this part alone")
    parser.add_argument("--exports", action="store_true", help="the measurement in other formats, too")
    for name in ("ear", "scan", "experiment"):
        parser.add_argument(f"--{name}", nargs="+", default=[], metavar="NAME=VALUE", help=f"of the {name}")
    options = parser.parse_args(arguments)
    ear = with_settings(Ear(), options.ear, parser)
    scan = with_settings(Scan(seed=options.seed), options.scan, parser)
    experiment = with_settings(Experiment(seed=options.seed), options.experiment, parser)
    own = options.out == HERE
    truth = simulate_study(
        ear,
        replace(scan, format="") if options.only == "ldv" else scan,
        None if options.only == "scan" else experiment,
        options.out,
        name="sample ear" if own else f"simulated ear {options.seed}",
    )
    if (own or options.exports) and options.only != "scan":
        recording = replace(simulate_recording(truth, experiment), fiducials=())
        for fmt in EXPORTS:
            write_recording(options.out / "exports", recording, fmt)
    print(f"{options.out}: true mass {truth.mass.mass_kg * 1e6:.4f} mg")


if __name__ == "__main__":
    main()
