"""The result of `stapeskit.dof2kd`: stiffness and damping that print, draw and write themselves."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legacy.fitting.export_formats import exported, file_names, json_name, output_set
from legacy.fitting.kd_fit import KDFit
from legacy.fitting.montecarlo import MonteCarlo, monte_carlo_json, monte_carlo_section
from legacy.stapeskit.arrays import Array
from legacy.stapeskit.results import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from legacy.stapeskit.option_values import WithSd
    from legacy.stapeskit.page.page import Section


@dataclass(frozen=True, repr=False)
class KDResult(Result, KDFit):
    """Stiffness and damping with their uncertainty, record and page.

    Attributes
    ----------
    provenance : mapping
        Inputs, choices and versions.
    footplate_outline_mm : ndarray, (points, 2 or 3), or None
        Outline of the footplate in footplate axes, for pictures and the ring test.
    ligament_gap_mm : WithSd or None
        Width of the gap around the footplate as the scan shows it.
    scatter : MonteCarlo or None
        Refits of simulated repetitions, when they were asked for.
    files : tuple of Path
        Every file that was read; `write` never replaces one of them.
    """

    provenance: Mapping[str, Any] = field(default_factory=dict)
    footplate_outline_mm: Array | None = None
    ligament_gap_mm: WithSd | None = None
    scatter: MonteCarlo | None = None
    files: tuple[Path, ...] = ()

    @property
    def title(self) -> str:
        """What this is."""
        return f"Stiffness and damping for {', '.join(self.dof)}"

    def summary(self) -> Sequence[tuple[str, str]]:
        """Return K, D, modes and fit with their uncertainty."""
        from legacy.fitting.report.at_a_glance import summary_rows

        return summary_rows(self)

    def content(self) -> dict[str, Any]:
        """Return the content of kd.json."""
        from legacy.fitting.report.kd_json import kd_json
        from legacy.fitting.report.ring_section import ring_json, ring_of

        content = kd_json(self, self.provenance)
        content["ring"] = ring_json(ring_of(self, self.footplate_outline_mm, self.ligament_gap_mm))
        if self.scatter is not None:
            content["monte_carlo"] = monte_carlo_json(self, self.scatter)
        return content

    def sections(self) -> list[Section]:
        """Return the sections of the page, without warnings and inputs."""
        from legacy.fitting.report.sections import kd_sections

        scatter = [] if self.scatter is None else [monte_carlo_section(self, self.scatter)]
        return [*kd_sections(self, self.footplate_outline_mm, self.ligament_gap_mm), *scatter]

    def to_frame(self) -> DataFrame:
        """Return one row a parameter: value, standard deviations and 95 % interval, SI."""
        import pandas as pd

        from legacy.fitting.model.parameter_vector import join

        intervals = self.intervals
        return pd.DataFrame(
            {
                "parameter": list(self.parameters),
                "value_si": join(self.stiffness, self.damping),
                "standard_deviation_si": np.sqrt(np.diag(self.covariance)),
                "noise_only_sd_si": np.sqrt(np.diag(self.noise_covariance)),
                "low_95_si": intervals[:, 0],
                "high_95_si": intervals[:, 1],
            }
        )

    def plot(self) -> Figure:
        """Draw measured and simulated responses of the first run."""
        from legacy.fitting.report.figures import response_figure
        from legacy.fitting.report.responses import responses

        drawn = responses(self)
        return response_figure(drawn, int(np.min(drawn.run)))

    def write_into(self, folder: Path, name: str, export: Sequence[str] = ()) -> list[str]:
        """Write ``name``, X.json, the page X.html and exports into an empty folder; return their names."""
        from legacy.fitting.report.sections import kd_page

        names = file_names(name, export)
        text = json.dumps(self.content(), indent=1) + "\n"
        (Path(folder) / name).write_text(text, encoding="utf-8")
        kd_page(self, self.provenance, self.sections()).write(Path(folder) / names[1])
        for kind, file in zip(export, names[2:], strict=True):
            (Path(folder) / file).write_bytes(exported(self, kind))
        return list(names)

    def write(
        self, folder: Path | str, *, force: bool = False, name: str = "kd.json", export: Sequence[str] = ()
    ) -> tuple[Path, ...]:
        """Write kd.json, kd.html and exports by their names (fitting.export_formats.EXPORTS)."""
        json_name(Path(name))
        outputs = output_set(Path(folder), name, self.files, force, export)
        outputs.check()
        with outputs.staged() as stage:
            names = self.write_into(stage, name, export)
        return tuple(outputs.folder / name for name in names)
