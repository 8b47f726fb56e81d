"""Damaged small inputs of ct2mass: files of landmarks and of the calibration of grey values."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator

from tests.fuzz.case import Case
from tests.fuzz.mutations import json_bytes, mutate_bytes, mutate_numbers, mutate_table, mutate_tree

_CALIBRATIONS = (
    b"points = [[2000, 0], [20000, 1900]]\nsd_kg_m3 = 30\n",
    b"points_mg_ha_cm3 = [[3100, 0], [9800, 400], [16400, 800]]\nkg_m3_at_zero = 1000\n"
    b"kg_m3_per_mg_ha_cm3 = 0.75\n",
)
_TABLES = {
    "a.csv": b"name,x_mm,y_mm,z_mm\nanterior,1.0,2.0,3.0\nposterior,-1.0,2.0,3.0\nhead,0.0,5.0,1.5\n",
    "a.fcsv": b"# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n"
    b"# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    b"1,1.0,2.0,3.0,0,0,0,1,1,1,0,anterior,,\n2,-1.0,2.0,3.0,0,0,0,1,1,1,0,head,,\n",
}
_PICKED = (
    b'<!DOCTYPE PickedPoints>\n<PickedPoints>\n <point x="1.0" y="2.0" z="3.0" name="anterior" active="1"/>\n'
    b' <point x="-1.0" y="2.0" z="3.0" name="head" active="1"/>\n</PickedPoints>\n'
)
_MARKUPS = {
    "markups": [
        {
            "type": "Fiducial",
            "coordinateSystem": "LPS",
            "controlPoints": [
                {"id": "1", "label": "anterior", "position": [1.0, 2.0, 3.0]},
                {"id": "2", "label": "head", "position": [0.0, 5.0, 1.5]},
            ],
        }
    ]
}


def cases(rng: random.Random) -> Iterator[Case]:
    """Yield damaged files without end."""
    while True:
        yield rng.choice((_calibration, _table, _picked, _markups))(rng)


def _calibration(rng: random.Random) -> Case:
    damage = rng.choice((mutate_bytes, mutate_numbers))
    return Case(
        "calibration", {"a.toml": damage(rng, rng.choice(_CALIBRATIONS))}, ("read_calibration", "a.toml")
    )


def _table(rng: random.Random) -> Case:
    name = rng.choice(sorted(_TABLES))
    damage = rng.choice((mutate_bytes, mutate_numbers, mutate_table))
    return Case(f"landmarks {name}", {name: damage(rng, _TABLES[name])}, ("read_landmarks", name))


def _picked(rng: random.Random) -> Case:
    damage = rng.choice((mutate_bytes, mutate_numbers))
    return Case("landmarks a.pp", {"a.pp": damage(rng, _PICKED)}, ("read_landmarks", "a.pp"))


def _markups(rng: random.Random) -> Case:
    text = json_bytes(rng, mutate_tree(rng, json.loads(json.dumps(_MARKUPS))))
    return Case("landmarks a.mrk.json", {"a.mrk.json": text}, ("read_landmarks", "a.mrk.json"))
