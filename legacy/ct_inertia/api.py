"""`stapeskit.ct2mass`: the command ct2mass as a function."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from legacy.stapeskit.faults import translate_option_names
from legacy.stapeskit.option_names import as_keyword

if TYPE_CHECKING:
    from legacy.ct_inertia.results import MassResult


@translate_option_names(as_keyword)
def ct2mass(scan: str | os.PathLike[str] | None = None, **options: Any) -> MassResult:
    """Find stapes, frames and mass matrix in a micro-CT scan.

    Parameters
    ----------
    scan : path, optional
        Volume, folder of slices, or closed surface mesh (mm); may be left out with ``labels``.
    **options
        The options of the command ct2mass by their names: ``density``, ``mass_mg``, ``spacing``, ``labels``,
        ``side``, ``anterior``, ``threshold``, ``seed``, ``box`` ... ``density`` and ``mass_mg`` are numbers
        or (value, standard deviation).

    Raises
    ------
    StapeskitError
        An option is unknown (the nearest is named), or options or files are at fault; all of it together.

    Examples
    --------
    >>> mass = ct2mass("scan.tif", density=(1900, 60), anterior=(-0.9, 0.1, 0))  # doctest: +SKIP
    """
    from legacy.ct_inertia.options import MassOptions
    from legacy.ct_inertia.results import mass_of

    return mass_of(MassOptions.of(scan=scan, **options))
