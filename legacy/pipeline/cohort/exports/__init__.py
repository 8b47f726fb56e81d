"""The table of exports of a cohort: each is a module of this folder and one line here."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from legacy.pipeline.cohort.cohort_laws import CohortLaws


class Export(NamedTuple):
    """An entry: the module that writes, the files that it writes, and a summary for the help."""

    module: str
    files: tuple[str, ...]
    summary: str

    def write(self, folder: Path, cohort: CohortLaws, content: Mapping[str, Any]) -> None:
        """Write the files into a folder.

        Parameters
        ----------
        content : mapping
            Of cohort.json.
        """
        import_module(f"legacy.pipeline.cohort.exports.{self.module}").write(folder, cohort, content)


EXPORTS = {
    "csv": Export("laws_csv", ("cohort_laws.csv",), "table of the laws"),
    "xlsx": Export("xlsx", ("cohort.xlsx",), "workbook of ears, laws and components"),
    "latex": Export("latex", ("cohort.tex",), "tables of ears and planned laws"),
    "svg": Export("svg", ("cohort_laws.svg", "cohort_exponents.svg"), "figures of the planned laws"),
    "hdf5": Export("hdf5", ("cohort.h5",), "all matrices with their covariances"),
    # the last one: it lists the files of the others
    "rocrate": Export("rocrate", ("ro-crate-metadata.json",), "RO-Crate description of the run"),
}
