"""`stapeskit.ct2mass`: the command ct2mass as a function."""

from __future__ import annotations

import os
from typing import Any

from ct_inertia.options import MassOptions
from ct_inertia.results import MassResult
from stapeskit.options import with_options


@with_options(MassOptions)
def ct2mass(scan: str | os.PathLike[str] | None = None, **options: Any) -> MassResult:
    """Find stapes, frames and mass matrix in a micro-CT scan.

    Parameters
    ----------
    scan : path, optional
        Volume, folder of slices, or closed surface mesh (mm); may be left out with ``labels``.
    **options
        The options of the command ct2mass by their names. ``density`` and ``mass_mg`` are numbers or
        (value, standard deviation).

    Raises
    ------
    StapeskitError
        An option is unknown (the nearest is named), or options or files are at fault; all of it together.

    Examples
    --------
    >>> mass = ct2mass("scan.tif", density=(1900, 60), anterior=(-0.9, 0.1, 0))  # doctest: +SKIP
    """
    from ct_inertia.ct2mass import measure_mass

    path = None if scan is None else os.fspath(scan)
    return measure_mass(MassOptions.of(scan=path, **options))
