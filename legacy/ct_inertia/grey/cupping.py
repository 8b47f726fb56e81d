"""Cupping: bone that beam hardening leaves darker towards the axis of rotation, or deep inside itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legacy.ct_inertia.calibrated import calibrated
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.warnings import Notice

# Most voxels of the fit, thinned evenly above: for time only.
_MOST = 60_000
_SIGNIFICANT = calibrated("cupping.significant")
_LEAST_RMS = calibrated("cupping.least_rms")
_LEAST_DEEP = calibrated("cupping.least_deep")


@dataclass(frozen=True)
class Cupping:
    """A grey value of bone that rises outward from the scan's axis of rotation, along z of its slices.

    Attributes
    ----------
    curvature : float
        Grey value per mm2 of squared distance from the axis.
    plane : ndarray, (4,)
        1, x, y, z of what a level and its slope hold of the squared distance already, mm2 and mm.
    range_share : float
        Between the darkest and the brightest percent of the inside, as a share of the contrast.
    """

    curvature: float
    plane: Array
    range_share: float

    def at(self, places_mm: Array) -> Array:
        """Return the grey value (n,) above level and slope at places (n, 3) from the box's first voxel."""
        return self.curvature * _residual(places_mm, self.plane)


def _residual(places_mm: Array, plane: Array) -> Array:
    squared = places_mm[:, 0] ** 2 + places_mm[:, 1] ** 2
    return np.asarray(squared - plane[0] - places_mm @ plane[1:])


def find_cupping(
    values: Array,
    places_mm: Array,
    contrast: float,
    correlation: float,
    sloping: bool,
) -> Cupping | None:
    """Search for cupping in the grey values (n,) of pure bone at places (n, 3); None where there is none.

    Parameters
    ----------
    values : ndarray, (n,)
    places_mm : ndarray, (n, 3)
        From the box's first voxel along x, y, z.
    contrast : float
        Between bone and air.
    correlation : float
        Variance of sums of noise over that of white noise.
    sloping : bool
        The level of bone already follows a slope.

    Notes
    -----
    What a scanner's own correction leaves of beam hardening is a paraboloid about the axis of rotation
    (Ketcham and Carlson 2001, doi:10.1016/S0098-3004(00)00116-3). Grey values are fitted by a level, a slope
    along each axis, a square along z and the squared distance from the axis: a density that changes along
    the bone, evenly or not, is none. With a slope of its own the fit does not need the position of the axis.
    """
    step = max(1, len(values) // _MOST)
    grey, places = values[::step], places_mm[::step]
    if len(grey) < 100:
        return None
    flat = np.column_stack([np.ones(len(grey)), places])
    middle = places.mean(axis=0)
    squared = places[:, 0] ** 2 + places[:, 1] ** 2
    design = np.column_stack([flat, (places[:, 2] - middle[2]) ** 2, squared])
    others = design[:, :5]
    radial = squared - others @ np.linalg.lstsq(others, squared, rcond=None)[0]
    curvature = float(radial @ grey / (radial @ radial))
    left = grey - design @ np.linalg.lstsq(design, grey, rcond=None)[0]
    sd = float(left.std()) * np.sqrt(correlation / (radial @ radial))
    plane = np.array([squared.mean(), 0.0, 0.0, 0.0])
    if sloping:
        plane = np.linalg.lstsq(flat, squared, rcond=None)[0]
    # The slope is free: what is left of the paraboloid without it is what shows that it is one.
    shown = curvature * float(radial.std())
    if curvature < _SIGNIFICANT * sd or shown < _LEAST_RMS * contrast:
        return None
    low, high = np.percentile(curvature * _residual(places, plane), [1.0, 99.0])
    return Cupping(curvature, plane, float(high - low) / contrast)


def cupping_notice(cupping: Cupping, errors: tuple[float, float, float]) -> Notice:
    """Return the warning on cupping, with its errors of volume (share), centre (mm) and inertia (share)."""
    volume, centre, inertia = errors
    text = (
        f"Bone grows darker towards the scan's axis of rotation, by {100.0 * cupping.range_share:.1f} % "
        f"across the stapes: cupping, which beam hardening leaves. It shifts the volume by about "
        f"{100.0 * volume:.2f} %, the centre of mass by {1e3 * centre:.1f} um and the inertia by "
        f"{100.0 * inertia:.2f} %; the budget holds that (cupping, uneven bone). Reconstruct with more "
        f"correction of beam hardening, or scan with a stronger filter."
    )
    return Notice("bone_cupping", text)


def deep_cupping_notice(change: float, contrast: float) -> tuple[Notice, ...]:
    """Warn when the deepest bone voxels are darker, by ``-change``, than all voxels free of blur."""
    if change > -_LEAST_DEEP * contrast:
        return ()
    text = (
        f"Bone grows darker towards its inside, by {-100.0 * change / contrast:.1f} %: cupping, which beam "
        f"hardening leaves, or bone that is less dense there. The volume may be off by as much; the budget "
        f"holds that (levels). Reconstruct with more correction of beam hardening."
    )
    return (Notice("bone_cupping", text),)
