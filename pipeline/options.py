"""From the tables of a study file to the options of the three rooms, and back to words a study file knows."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from pydantic import BaseModel

from pipeline.study import Fit, Ldv, Scan
from stapeskit.faults import Fault

if TYPE_CHECKING:
    from ct_inertia.options import MassOptions
    from fitting.options import KDOptions
    from kinematics.measure_motion import MotionInputs
    from kinematics.points2dof import Options
    from kinematics.readers import InputOptions
    from kinematics.signals.series_options import SeriesOptions
    from stapeskit.page.page import Section

_OTHER_NAMES = {
    "spacing": "spacing_mm",
    "density": "density_kg_m3",
    "seed": "seed_mm",
    "box": "box_mm",
    "voxel_size_sd": "voxel_size_sd_percent",
    "band": "band_hz",
    "exclude": "exclude_hz",
    "axes_sd": "axes_sd_deg",
    "beam_sd": "beam_sd_deg",
    "gain_sd": "gain_sd_percent",
    "resolution": "resolution_hz",
    "period": "period_s",
    "frf_band": "frf_band_hz",
}
_SERIES = {
    "reference_channel": "reference",
    "frf": "estimator",
    "window": "window",
    "overlap": "overlap",
    "averages": "averages",
    "resolution_hz": "resolution_hz",
    "period_s": "period_s",
    "skip_periods": "skip_periods",
    "steps": "steps",
    "settle": "settle",
    "frf_band_hz": "band_hz",
}
_TABLES: dict[str, type[BaseModel]] = {"scan": Scan, "ldv": Ldv, "fit": Fit}
_OPTION = re.compile(r"--[a-z]+(?:-[a-z]+)*")


def in_study_words(text: str, table: str = "scan") -> str:
    """Name the keys of a study file where a message of a single command names its options.

    Parameters
    ----------
    text : str
    table : str
        Where a key is looked for first, ``scan``, ``ldv`` or ``fit``: some stand in more than one.
    """

    def key(found: re.Match[str]) -> str:
        option = found.group()[2:].replace("-", "_")
        name = _OTHER_NAMES.get(option, option)
        for home in (table, *_TABLES):
            if name in _TABLES[home].model_fields:
                return f"{home}.{name}"
        return found.group()

    return _OPTION.sub(key, text)


def faults_in_study_words(faults: Iterable[Fault], table: str = "scan") -> list[Fault]:
    """Name options in faults by their keys of the study file."""
    return [
        Fault(
            in_study_words(fault.thing, table),
            in_study_words(fault.expected, table),
            in_study_words(str(fault.got), table),
            fault.where,
            in_study_words(fault.next_step, table),
        )
        for fault in faults
    ]


def section_in_study_words(section: Section, table: str) -> Section:
    """Return a section of a page whose texts name the keys of a study file."""
    from markupsafe import Markup

    return replace(section, blocks=[Markup(in_study_words(str(block), table)) for block in section.blocks])


def mass_options(scan: Scan) -> MassOptions:
    """Return the options of `ct2mass`."""
    from ct_inertia.options import MassOptions

    values = {name: getattr(scan, name) for name in type(scan).model_fields}
    values["scan"] = values.pop("file")
    values["density"] = values.pop("density_kg_m3")
    return MassOptions(**values)


def motion_options(ldv: Ldv) -> Options:
    """Return the options of `points2dof`."""
    from kinematics.points2dof import Options
    from kinematics.registration.geometry_options import priors

    geometry = priors(ldv.calibrate, ldv.axes_sd_deg, ldv.beam_sd_deg, ldv.gain_sd_percent)
    return Options(
        ldv.dof,
        ldv.reference,
        ldv.robust,
        calibrate=geometry,
        reference_noise=ldv.reference_noise,
        repeats=ldv.repeats,
    )


def input_options(ldv: Ldv) -> InputOptions:
    """Return what a study says about its vibrometer files."""
    from kinematics.readers import InputOptions

    return InputOptions(
        ldv.body,
        ldv.run,
        ldv.beam,
        ldv.amplitude,
        ldv.length_unit,
        ldv.n_avg,
        ldv.mapping,
        _series_options(ldv),
    )


def motion_inputs(ldv: Ldv) -> MotionInputs:
    """Return the vibrometer files of a study, and the coordinates that they are in."""
    from kinematics.measure_motion import MotionInputs

    return MotionInputs(
        files=ldv.files,
        points=ldv.points,
        fiducials=ldv.fiducials,
        plate_points=ldv.plate_points,
        bone_points=ldv.bone_points,
        frame=ldv.frame,
        mirror=ldv.mirror,
        mirror_points=ldv.mirror_points,
        reading=input_options(ldv),
    )


def _series_options(ldv: Ldv) -> SeriesOptions | None:
    """Return how time series are turned into responses; universal files need no table of their channels."""
    from kinematics.readers.formats import describes_series
    from kinematics.signals.series_options import SeriesOptions
    from pipeline.errors import PipelineError
    from stapeskit.faults import Fault, raise_all

    values = {name: value for key, name in _SERIES.items() if (value := getattr(ldv, key)) is not None}
    if ldv.channels is not None or (values and any(describes_series(path) for path in ldv.files)):
        return SeriesOptions(ldv.channels, **values)
    given = [key for key in _SERIES if getattr(ldv, key) is not None]
    step = "It says how time series become frequency responses"
    raise_all(
        PipelineError, [Fault(f"ldv.{key}", "given with ldv.channels", "alone", "", step) for key in given]
    )
    return None


def fit_options(fit: Fit) -> KDOptions:
    """Return the options of `dof2kd`."""
    from fitting.options import KDOptions

    return KDOptions(**{name: getattr(fit, name) for name in type(fit).model_fields})
