"""Options of the command or of a study, turned into facts about the files that the files do not contain."""

from __future__ import annotations

from legacy.kinematics.errors import KinematicsError
from legacy.kinematics.options import LdvOptions, SeriesOptions
from legacy.kinematics.readers.input_options import InputOptions
from legacy.kinematics.readers.recognise_format import describes_series
from legacy.stapeskit.faults import Fault, collect_faults, raise_all
from legacy.stapeskit.options import declared


def input_options(options: LdvOptions) -> InputOptions:
    """Return what the options say about the files.

    Raises
    ------
    KinematicsError
        A rule cannot be read, or options of time series are given where no file holds any.
    """
    faults: list[Fault] = []
    series: SeriesOptions | None = None
    result = InputOptions()
    with collect_faults(faults):
        series = _series(options)
    with collect_faults(faults):
        result = InputOptions(
            options.body,
            options.run,
            options.beam or "",
            options.amplitude or "",
            options.length_unit or "",
            options.n_avg,
            options.mapping,
            series,
        )
    raise_all(KinematicsError, faults)
    return result


def _series(options: LdvOptions) -> SeriesOptions | None:
    """Return how time series are turned into responses; universal files need no table of their channels."""
    chosen = options.series_given
    if not chosen:
        return None
    if "channels" not in chosen and not any(describes_series(path) for path in options.ldv):
        step = "It says how time series become frequency responses"
        names = [option.name for option in declared(LdvOptions) if option.field in chosen]
        raise_all(
            KinematicsError,
            [Fault(f"{{{name}}}", "given with {channels}", "alone", "", step) for name in names],
        )
    return SeriesOptions(**chosen)
