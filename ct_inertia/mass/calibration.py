"""Density from grey values: the straight line of a calibration file, and the mass of a body by it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ct_inertia.bodies import Moments
from ct_inertia.mass.properties import MassProperties, check_density
from stapeskit.arrays import Array
from stapeskit.faults import StapeskitError
from stapeskit.option_types import number
from stapeskit.options import read_toml, unknown
from stapeskit.records.mass_matrix import parameter_transfer

_LARGEST = 1e12  # grey values and densities: products and quotients of two stay exact enough in doubles
_KEYS = ("points", "points_mg_ha_cm3", "kg_m3_at_zero", "kg_m3_per_mg_ha_cm3", "sd_kg_m3")
_CORRECT = "Correct it in the file"


@dataclass(frozen=True)
class Calibration:
    """density = intercept + slope * grey value, for pure bone.

    Attributes
    ----------
    slope_kg_m3 : float
        Per grey value.
    sd_kg_m3 : float or None
        Standard deviation of a density read off the line; None when not given.
    """

    slope_kg_m3: float
    intercept_kg_m3: float
    sd_kg_m3: float | None = None

    def density(self, grey: float) -> float:
        """Return the density of pure bone of a grey value, kg/m3."""
        return self.intercept_kg_m3 + self.slope_kg_m3 * grey


def read_calibration(path: Path) -> Calibration:
    """Read a calibration file.

    Parameters
    ----------
    path : Path
        TOML with ``points = [[grey, kg_m3], ...]``, two or more (a least-squares line), or
        ``points_mg_ha_cm3 = [[grey, mg_ha_cm3], ...]`` of a hydroxyapatite phantom together with
        ``kg_m3_at_zero`` and ``kg_m3_per_mg_ha_cm3``, which turn mineral into bone density. Optional
        ``sd_kg_m3``.

    Raises
    ------
    StapeskitError
        The file is missing, no TOML, has an unknown or missing key, fewer than two grey values, or a line
        that does not rise.
    """
    path = Path(path)
    table = read_toml(path)
    wrong = next((key for key in table if key not in _KEYS), None)
    if wrong is not None:
        raise StapeskitError(unknown(wrong, _KEYS, path.name))
    mineral = "points_mg_ha_cm3" in table
    if mineral == ("points" in table):
        got, step = "both" if mineral else "neither", "Keep one of the two"
        expected = "a file with either points or points_mg_ha_cm3"
        raise StapeskitError.of("--calibration", expected, got, path.name, step)
    points = _points(table["points_mg_ha_cm3" if mineral else "points"], path.name)
    if mineral:
        offset, factor = (_number(table, key, path.name) for key in ("kg_m3_at_zero", "kg_m3_per_mg_ha_cm3"))
        points[:, 1] = offset + factor * points[:, 1]
    slope, intercept = np.polyfit(points[:, 0], points[:, 1], 1)
    if not slope > 0.0:
        step = "Check the order of grey value and density in each pair"
        expected, got = "rising with the grey value", f"slope {slope:g}"
        raise StapeskitError.of("the calibration line", expected, got, path.name, step)
    sd = _number(table, "sd_kg_m3", path.name) if "sd_kg_m3" in table else None
    if sd is not None and sd < 0.0:
        raise StapeskitError.of("sd_kg_m3", "0 or more", sd, path.name, _CORRECT)
    return Calibration(float(slope), float(intercept), sd)


def _points(value: Any, file: str) -> Array:
    try:
        points = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] != 2 or len(np.unique(points[:, 0])) < 2:
        step = "Give for example points = [[2000, 0], [20000, 1900]]"
        expected = "at least two pairs [grey, density]"
        raise StapeskitError.of("the calibration points", expected, value, file, step)
    # Squares of larger numbers, and quotients of smaller differences, are no numbers any more.
    if not np.all(np.abs(points) < _LARGEST) or np.ptp(points[:, 0]) < 1.0 / _LARGEST:
        expected = f"finite, below {_LARGEST:g}, at different grey values"
        raise StapeskitError.of("the calibration points", expected, value, file, _CORRECT)
    return points


def _number(table: Mapping[str, Any], key: str, file: str) -> float:
    value: Any = table.get(key)
    try:
        return number(value if not isinstance(value, str) else None)
    except (ValueError, OverflowError):
        raise StapeskitError.of(key, "a number", value, file, _CORRECT) from None


def from_calibration(
    grey: Moments, shape: Moments, air: float, bone: float, line: Calibration
) -> MassProperties:
    """Return the mass properties of a body with a density from the grey value of each voxel.

    Parameters
    ----------
    grey : Moments
        Integral of (g - air) / (bone - air): the partial-volume moments.
    shape : Moments
        Of the bone's shape, every part of it counted alike.
    air, bone : float
        Grey levels.

    Raises
    ------
    StapeskitError
        The mean density lies outside 500 to 4000 kg/m3, where no bone is.

    Notes
    -----
    A voxel with the share s of bone of grey value b has g = (1 - s) air + s b and the mass s (intercept +
    slope b) = slope (g - air) + s (intercept + slope air), so that the mass moments are slope (bone - air)
    times the grey moments plus the line's density at air times the moments of the shape. The air in a voxel
    of the boundary has no weight, and bone that varies from place to place is weighed where it lies.
    """
    inner, rest = line.slope_kg_m3 * (bone - air), line.density(air)
    density = (inner * grey.volume_mm3 + rest * shape.volume_mm3) / shape.volume_mm3
    got = f"{density:.4g} kg/m3 at its mean grey value (bone {bone:.5g}, air {air:.5g})"
    step = "Check the grey values and units of the points of --calibration"
    check_density("the density of the stapes by --calibration", density, got, step)
    weighed, parts = grey.volume_parameters(grey.centroid_mm)
    plain, _ = replace(shape, contributions={}).volume_parameters(grey.centroid_mm)
    parameters = inner * weighed + rest * plain
    com_m = parameters[1:4] / parameters[0]
    linear = parameter_transfer(np.eye(3), com_m)
    parameters = linear @ parameters
    contributions = {name: density**2 * linear @ part @ linear.T for name, part in parts.items()}
    if line.sd_kg_m3 is not None:
        step_of_line = parameters * (line.sd_kg_m3 / density)
        contributions["calibration"] = np.outer(step_of_line, step_of_line)
    com_mm = grey.centroid_mm + com_m * 1e3
    return MassProperties(density, shape.volume_m3, com_mm, parameters, contributions)
