"""Damaged records: mass.json, dof.csv, dof.h5, M.csv, study.toml, plan.toml, --config, words of commands."""

from __future__ import annotations

import io
import json
import random
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.case import Case
from tests.fuzz.mutations import (
    INTEGERS,
    NUMBERS,
    TEXTS,
    json_bytes,
    mutate_bytes,
    mutate_numbers,
    mutate_table,
    mutate_tree,
)

_LINES = 12
_FAST = 0.97  # share of cases that take a single reader: a whole command takes a hundred times as long
_MOST_VALUES = 1 << 20  # of a data set that is changed: the one made large by a change before is not read
_PINV = ("dof2kd", "dof.csv", "--mass", "M.csv", "--estimator", "pinv")


def cases(rng: random.Random) -> Iterator[Case]:
    """Yield damaged records without end."""
    while True:
        yield rng.choice(_MAKERS if rng.random() < _FAST else _WHOLE)(rng)


@cache
def sound() -> dict[str, bytes]:
    """Make one sound record of every kind."""
    from legacy.ct_inertia.cli import work
    from legacy.ct_inertia.surface.surface import write_surface
    from legacy.fitting.plan.plan_options import PLAN_EXAMPLE
    from legacy.pipeline.template import TEMPLATE
    from legacy.stapeskit.records.motion_files import write_motion
    from sample_volumes.bodies import stapes_in_footplate
    from tests.fitting.cases import M, paper_motion

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_surface(folder / "stapes.ply", stapes_in_footplate())
        work(
            [
                *(str(folder / "stapes.ply"), "--density", "1900+-60", "--no-report", "--quiet"),
                *("--anterior", "1,0,0", "--out", str(folder / "mass")),
            ]
        )
        motion = paper_motion(0.05, 0, lines=_LINES)
        ones = np.ones_like(motion.chi2)
        write_motion(folder, "dof", replace(motion, chi2=42.0 * ones, n_dof=42.0 * ones))
        np.savetxt(folder / "M.csv", M, delimiter=",")
        found = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
        found["mass.json"] = (folder / "mass" / "mass.json").read_bytes()
    found["study.toml"] = TEMPLATE.encode()
    found["plan.toml"] = PLAN_EXAMPLE.encode()
    return found


def prepare() -> None:
    """Make the sound records before the process is forked."""
    sound()


def _mass(rng: random.Random) -> Case:
    value = mutate_tree(rng, json.loads(sound()["mass.json"]))
    return Case("mass.json", {"mass.json": json_bytes(rng, value)}, ("read_mass", "mass.json"))


def _motion_table(rng: random.Random) -> Case:
    text = sound()["dof.csv"]
    damage = rng.choice((mutate_table, mutate_numbers, mutate_bytes))
    files = {"dof.csv": damage(rng, text)}
    if rng.random() < 0.2:
        files["dof.h5"] = sound()["dof.h5"]
    return Case(f"dof.csv {damage.__name__}", files, ("read_motion", "dof.csv"))


def _motion_bytes(rng: random.Random) -> Case:
    return Case(
        "dof.h5 bytes", {"dof.h5": mutate_bytes(rng, sound()["dof.h5"], head=2048)}, ("read_motion", "dof.h5")
    )


def _motion_structure(rng: random.Random) -> Case:
    """Change data sets and attributes of the HDF5 file, with check sums that hold."""
    import h5py

    stream = io.BytesIO(sound()["dof.h5"])
    with h5py.File(stream, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        for _ in range(rng.randint(1, 2)):
            if rng.random() < 0.3:
                _change_attribute(rng, file)
                continue
            name = rng.choice(names)
            if name in file:
                _change_data(rng, file, name)
    return Case("dof.h5 structure", {"dof.h5": stream.getvalue()}, ("read_motion", "dof.h5"))


def _change_attribute(rng: random.Random, file: Any) -> None:
    name = rng.choice(list(file.attrs))
    if rng.random() < 0.3:
        del file.attrs[name]
        return
    text = file.attrs[name]
    odd = (
        rng.choice(TEXTS[:6]).replace("\x00", ""),
        3,
        1.5,
        [1, 2],
        "[[" * 5000,
        "{}",
        "[1]",
        '[{"code": 3}]',
    )
    file.attrs[name] = rng.choice(
        (*odd, mutate_numbers(rng, str(text).encode()).decode("utf-8", "replace")[:60_000])
    )


def _change_data(rng: random.Random, file: Any, name: str) -> None:
    old = file[name]
    values = old[()] if getattr(old, "shape", ()) and old.size < _MOST_VALUES else None
    del file[name]
    match rng.randrange(7):
        case 0:
            return
        case 1:
            file.create_group(name)
        case 2 if values is not None and values.ndim:
            file[name] = values[: rng.randrange(len(values) + 1)]
        case 3 if values is not None and values.dtype.kind in "fc" and values.size:
            flat = values.ravel()
            flat[rng.randrange(flat.size)] = rng.choice((np.nan, np.inf, -1.0, 0.0, 1e300, -1e-300))
            file[name] = values
        case 4 if values is not None and values.dtype.kind in "fci":
            real = np.abs(values) if values.dtype.kind == "c" else values
            file[name] = real.astype(rng.choice(("f4", "i4", "c16", "S8", "f8")))
        case 5:
            file.create_dataset(name, shape=(1 << rng.choice((10, 31, 40)),), dtype="f8", chunks=(1024,))
        case _:
            file[name] = rng.choice((3.0, b"text", [b"a", b"a"], np.zeros((2, 2)), "text"))


def _matrix(rng: random.Random) -> Case:
    files = {"M.csv": mutate_table(rng, sound()["M.csv"]), "dof.csv": sound()["dof.csv"]}
    return Case(
        "M.csv", files, ("dof2kd", "dof.csv", "--mass", "M.csv", "--estimator", "pinv", "--bands", "0")
    )


def _fit(rng: random.Random) -> Case:
    """Fit damaged tables that are still read: the numbers themselves are what is odd."""
    files = {"dof.csv": mutate_numbers(rng, sound()["dof.csv"]), "M.csv": sound()["M.csv"]}
    estimator = rng.choice(("ml", "irls", "pinv", "constrained"))
    words = ("dof2kd", "dof.csv", "--mass", "M.csv", "--estimator", estimator, "--bands", "0")
    return Case(f"dof.csv fitted by {estimator}", files, words)


def _toml(rng: random.Random, text: bytes) -> bytes:
    lines = text.decode().split("\n")
    for _ in range(rng.randint(1, 3)):
        row = rng.randrange(len(lines))
        key = lines[row].lstrip("# ").partition("=")[0]
        number = rng.choice((*NUMBERS, *map(str, INTEGERS)))
        odd = rng.choice(("{}", "[]", "true", '""', '"x"', number, "1979-05-27", "[" * rng.choice((3, 5000))))
        match rng.randrange(6):
            case 0 | 1 | 2:
                lines[row] = f"{key}= {odd}"
            case 3:
                lines.insert(row, lines[row].lstrip("# "))
            case 4:
                lines[row] = "[" * rng.choice((1, 2, 3000)) + rng.choice(("scan", "a.b.c", "ldv")) + "]"
            case _:
                lines[row] = lines[row].lstrip("# ")
    found = "\n".join(lines).encode("utf-8", "replace")
    return mutate_bytes(rng, found) if rng.random() < 0.2 else found


def _study(rng: random.Random) -> Case:
    files = {"study.toml": _toml(rng, sound()["study.toml"]), "scan.tif": b"", "ldv.csv": b""}
    return Case("study.toml", files, ("read_study", "study.toml"))


def _plan(rng: random.Random) -> Case:
    return Case("plan.toml", {"plan.toml": _toml(rng, sound()["plan.toml"])}, ("read_plan", "plan.toml"))


def _config(rng: random.Random) -> Case:
    command = rng.choice(list(_OPTIONS))
    options = list(_OPTIONS[command]())
    lines = [f"{rng.choice(options).replace('_', '-')} = {_value(rng)}" for _ in range(rng.randint(1, 4))]
    text = "\n".join(lines).encode("utf-8", "replace")
    text = mutate_bytes(rng, text) if rng.random() < 0.2 else text
    return Case(
        f"--config of {command}", {"c.toml": text, "a": b"a"}, (f"parse_{command}", "a", "--config", "c.toml")
    )


def _value(rng: random.Random) -> str:
    number = rng.choice((*NUMBERS[:12], *map(str, INTEGERS)))
    text = json.dumps(rng.choice((*NUMBERS, *TEXTS)))
    table = "{a = " * rng.choice((1, 3000)) + "1"
    return rng.choice(
        (number, text, f"[{number}, {number}, {number}]", f"[[{text}]]", "true", "{}", table, "07:32:00")
    )


def _words(rng: random.Random) -> Case:
    command = rng.choice(list(_OPTIONS))
    options = list(_OPTIONS[command]())
    words = ["a"] if rng.random() < 0.8 else []
    for _ in range(rng.randint(1, 4)):
        value = rng.choice(
            (*NUMBERS, *TEXTS, "a", "1,2,3", "-1,0,nan", "1+-2", "y", "x,y,z", "stapes=1-99999999999")
        )
        flag = "--" + rng.choice(options).replace("_", "-")
        words += [f"{flag}={value}"] if rng.random() < 0.5 else [flag, value]
    return Case(f"words of {command}", {"a": b"a"}, (f"parse_{command}", *words))


def _names(module: str) -> Callable[[], list[str]]:
    @cache
    def names() -> list[str]:
        import importlib

        made = importlib.import_module(f"legacy.{module}.cli").parser()
        return [name for name in made.declared if name != "help"]

    return names


_OPTIONS = {"ct2mass": _names("ct_inertia"), "points2dof": _names("kinematics"), "dof2kd": _names("fitting")}
_MAKERS: tuple[Callable[[random.Random], Case], ...] = (
    *(_mass, _mass, _mass, _motion_table, _motion_table, _motion_bytes, _motion_structure, _motion_structure),
    *(_study, _study, _config, _config, _words, _words, _plan),
)
_WHOLE = (_matrix, _fit)
