"""Grey value to density: a straight line from a calibration file, and what it makes of a body."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from legacy.ct_inertia.errors import CtInertiaError
from legacy.ct_inertia.mass.mass_properties import MassProperties, from_density, unit_parameters
from legacy.ct_inertia.options import PLAUSIBLE_DENSITY
from legacy.ct_inertia.surface.moments import Moments
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.json_toml import is_finite_number, parse_toml
from legacy.stapeskit.records.mass_record import parameter_transfer

# Largest grey value and density of a calibration: products and quotients of two stay exact enough in doubles.
_LARGEST = 1e12
_KEYS = ("points", "points_mg_ha_cm3", "kg_m3_at_zero", "kg_m3_per_mg_ha_cm3", "sd_kg_m3")


@dataclass(frozen=True)
class Calibration:
    """density = intercept + slope * grey value, for pure bone.

    Attributes
    ----------
    slope_kg_m3 : float
        Per grey value.
    intercept_kg_m3 : float
    sd_kg_m3 : float or None
        Standard deviation of a density read off the line; None when not given.
    """

    slope_kg_m3: float
    intercept_kg_m3: float
    sd_kg_m3: float | None

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
    CtInertiaError
        The file is missing, no TOML, has an unknown or missing key, fewer than two grey values, or a line
        that does not rise.
    """
    path = Path(path)
    if not path.is_file():
        raise CtInertiaError.of("{calibration}", "an existing TOML file", path, next_step="Check the path")
    try:
        table = parse_toml(path.read_text(encoding="utf-8"))
    except ValueError as fault:
        raise CtInertiaError.of(
            "{calibration}", "valid TOML", fault, path.name, next_step="Correct the file"
        ) from fault
    unknown = sorted(set(table) - set(_KEYS))
    if unknown:
        raise CtInertiaError.of(
            "a key of {calibration}",
            f"one of {', '.join(_KEYS)}",
            unknown[0],
            path.name,
            next_step="Correct or remove that key",
        )
    mineral = "points_mg_ha_cm3" in table
    if mineral == ("points" in table):
        raise CtInertiaError.of(
            "{calibration}",
            "a file with either points or points_mg_ha_cm3",
            "both" if mineral else "neither",
            path.name,
            next_step="Keep one of the two",
        )
    points = _points(table["points_mg_ha_cm3" if mineral else "points"], path.name)
    if mineral:
        offset, factor = (_number(table, key, path.name) for key in ("kg_m3_at_zero", "kg_m3_per_mg_ha_cm3"))
        points[:, 1] = offset + factor * points[:, 1]
    slope, intercept = np.polyfit(points[:, 0], points[:, 1], 1)
    if not slope > 0.0:
        raise CtInertiaError.of(
            "the calibration line",
            "rising with the grey value",
            f"slope {slope:g}",
            path.name,
            next_step="Check the order of grey value and density in each pair",
        )
    sd = _number(table, "sd_kg_m3", path.name) if "sd_kg_m3" in table else None
    if sd is not None and sd < 0.0:
        raise CtInertiaError.of("sd_kg_m3", "0 or more", sd, path.name, next_step="Correct it in the file")
    return Calibration(float(slope), float(intercept), sd)


def _points(value: Any, file: str) -> Array:
    try:
        points = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] != 2 or len(np.unique(points[:, 0])) < 2:
        raise CtInertiaError.of(
            "the calibration points",
            "at least two pairs [grey, density]",
            value,
            file,
            next_step="Give for example points = [[2000, 0], [20000, 1900]]",
        )
    # Squares of larger numbers, and quotients of smaller differences, are no numbers any more.
    if not np.all(np.abs(points) < _LARGEST) or np.ptp(points[:, 0]) < 1.0 / _LARGEST:
        raise CtInertiaError.of(
            "the calibration points",
            f"finite, below {_LARGEST:g}, at different grey values",
            value,
            file,
            next_step="Correct them in the file",
        )
    return points


def _number(table: dict[str, Any], key: str, file: str) -> float:
    value: Any = table.get(key)
    if isinstance(value, int | float) and is_finite_number(value):
        return float(value)
    raise CtInertiaError.of(key, "a number", value, file, next_step="Correct it in the file")


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
    line : Calibration

    Notes
    -----
    A voxel with the share s of bone of grey value b has g = (1 - s) air + s b and the mass
    s (intercept + slope b) = slope (g - air) + s (intercept + slope air), so that the mass moments are
    slope (bone - air) times the grey moments plus the line's density at air times the moments of the shape.
    The air in a voxel of the boundary has no weight, and bone that varies from place to place is weighed
    where it lies.

    Raises
    ------
    CtInertiaError
        The mean density lies outside 500 to 4000 kg/m3, where no bone is.
    """
    inner = line.slope_kg_m3 * (bone - air)
    rest = line.density(air)
    density = (inner * grey.volume_mm3 + rest * shape.volume_mm3) / shape.volume_mm3
    if not PLAUSIBLE_DENSITY[0] <= density <= PLAUSIBLE_DENSITY[1]:
        raise CtInertiaError.of(
            "{calibration}",
            "a line that gives the stapes a density of 500 to 4000 kg/m3",
            f"{density:.4g} kg/m3 at its mean grey value (bone {bone:.5g}, air {air:.5g})",
            next_step="Check the grey values and units of its points",
        )
    main = from_density(grey, density, None)
    share = inner / density
    shift_m = (grey.centroid_mm - shape.centroid_mm) * 1e-3
    second = parameter_transfer(np.eye(3), shift_m) @ unit_parameters(shape) * rest
    parameters = main.parameters * share + second
    com_m = parameters[1:4] / parameters[0]
    linear = parameter_transfer(np.eye(3), com_m)
    contributions = {name: linear @ part @ linear.T for name, part in main.contributions.items()}
    if "cupping" not in contributions:
        # Calibrated grey values are densities: where nothing shades them, uneven bone is no doubt.
        contributions.pop("inhomogeneity", None)
    parameters = linear @ parameters
    if line.sd_kg_m3 is not None:
        step = parameters * (line.sd_kg_m3 / density)
        contributions["calibration"] = np.outer(step, step)
    return MassProperties(
        density, shape.volume_mm3 * 1e-9, grey.centroid_mm + com_m * 1e3, parameters, contributions
    )
