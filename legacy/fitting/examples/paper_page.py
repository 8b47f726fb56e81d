"""The paper, recomputed: every printed number of the procedure next to what this software finds.

Run as ``python -m fitting.examples.paper_page OUT.html [--force]``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from legacy.fitting.examples import paper
from legacy.fitting.examples.beam import Beam, deviations_percent
from legacy.fitting.examples.page_command import write_page
from legacy.fitting.examples.paper_figures import simulated_figure
from legacy.fitting.model.annular_ligament import ellipse_mm, ring_test
from legacy.fitting.model.model import NORMALISATION, Modes, modes, passive
from legacy.fitting.model.parameter_vector import entry_units
from legacy.fitting.model.principal_axes import principal_axes
from legacy.fitting.report.figures import principal_figure
from legacy.fitting.report.mode_shapes import shape_figure
from legacy.stapeskit.page import page
from legacy.stapeskit.page.page import Page, Section

_HEADER = ("quantity", "printed", "recomputed", "finding")
_AGREES = "agrees"
_DAMPING_UNITS = {"N/m": "N s/m", "N": "N s", "N m/rad": "N m s/rad"}
# Mean length and width of human footplates (Sim et al. 2013, JARO 14:159).
FOOTPLATE_MM = (2.71, 1.23)
_RING = (
    "an observation: a uniform ligament with the paper's K11 around an ellipse of the mean size would be "
    "softer in rocking; the outline of the paper's footplate is not published"
)


def paper_page() -> Page:
    """Return the page."""
    report = Page(
        "The paper, recomputed",
        "Numbers printed in the paper (CURAC 2019, p. 98 ff.) beside what stapeskit computes from them.",
    )
    report.sections.extend([_beam(), _matrices(), _print_cell_damping(), _modal(), _axes(), _simulate()])
    return report


def _row(quantity: str, printed: str, recomputed: str, finding: str = _AGREES) -> tuple[str, ...]:
    return quantity, printed, recomputed, finding


def _beam() -> Section:
    beam = Beam()
    entries = beam.coefficients
    names = ("c1 (N/mm)", "c2 (N)", "c3 (N mm)")
    rows = [_row("I = b h³/12 (mm⁴)", "0.44287", f"{beam.second_moment_mm4:.7f}")]
    for name, printed, value in zip(names, paper.TABLE_1_THEORY, entries, strict=True):
        percent = 100.0 * abs(value / printed - 1.0)
        finding = f"agrees within {percent:.0e} %; the rest is the rounding of I"
        rows.append(_row(f"{name}, Eq. 6", f"{printed:g}", f"{value:.6g}", finding))
    for name, printed, theory in zip(names, paper.TABLE_1_DEVIATION_PERCENT, entries, strict=True):
        estimate = theory * (1.0 + printed / 100.0)
        again = deviations_percent(estimate, theory)
        rows.append(
            _row(
                f"deviation of {name}, Eq. 9 (%)",
                f"{printed:g}",
                f"{again:.2f} for {estimate:.5g} or {theory * (1.0 - printed / 100.0):.5g}",
                "the estimates themselves are not printed",
            )
        )
    share = beam.mass_kg * 1e3
    rows.append(
        _row(
            "mass of the free beam (g)",
            "neglected",
            f"{share:.2f}",
            "not negligible: 36 % of a 10 mm steel cube with its beam piece (8.49 g); the model must carry "
            "the condensed mass and its coupling to the base",
        )
    )
    return Section("The beam experiment: Eqs. 6, 7, 9 and Table 1").add(page.table(_HEADER, rows, words=True))


def _matrices() -> Section:
    mass = paper.PAPER_MASS
    units = entry_units(paper.PAPER_DOF)
    radii = [1e3 * float(np.sqrt(mass[place, place] / mass[0, 0])) for place in (1, 2)]
    smallest = [float(np.linalg.eigvalsh(_unit(part))[0]) for part in (mass, paper.PAPER_STIFFNESS)]
    rows = [
        _row(
            "centre of mass x, z (mm)",
            "not printed",
            f"{1e3 * mass[0, 2] / mass[0, 0]:+.4f}, {-1e3 * mass[0, 1] / mass[0, 0]:+.4f}",
            "from M12 = -m z, M13 = +m x",
        ),
        _row(
            "radii of gyration about x, z (mm)",
            "not printed",
            f"{radii[0]:.3f}, {radii[1]:.3f}",
            "fit a stapes of 3.4 mm height and 2.7 mm length about its footplate",
        ),
        _row("M positive definite", "implied", "yes" if smallest[0] > 0.0 else "no"),
        _row("K positive definite", "implied", "yes" if smallest[1] > 0.0 else "no"),
    ]
    mass_units = [["kg", "kg m", "kg m"], ["kg m", "kg m²", "kg m²"], ["kg m", "kg m²", "kg m²"]]
    return Section("The stapes: M and K").add(
        page.matrix(mass, paper.PAPER_DOF, "M, SI, about the footplate centre.", units=mass_units),
        page.matrix(paper.PAPER_STIFFNESS, paper.PAPER_DOF, "K, SI.", units=units),
        page.table(_HEADER, rows, words=True),
    )


def _unit(matrix: np.ndarray) -> np.ndarray:
    root = np.sqrt(np.diag(matrix))
    return np.asarray(matrix / np.outer(root, root))


def _print_cell_damping() -> Section:
    printed, corrected = paper.PAPER_DAMPING_PRINTED, paper.PAPER_DAMPING_CORRECTED
    bad = modes(paper.PAPER_MASS, paper.PAPER_STIFFNESS, printed)
    good = modes(paper.PAPER_MASS, paper.PAPER_STIFFNESS, corrected)
    rows = [
        _row(
            "largest real part of the eigenvalues with D as printed (1/s)",
            "negative (its own constraint)",
            f"{bad.max_real_1_s:+.4g}",
            "UNSTABLE" if not bad.stable else _AGREES,
        ),
        _row(
            "D as printed positive semidefinite",
            "implied",
            "yes" if passive(printed) else "no",
            f"NOT PASSIVE: D12² = {printed[0, 1] ** 2:.3g} > D11 D22 = {printed[0, 0] * printed[1, 1]:.3g}",
        ),
        _row(
            "largest real part with D12 = 61.42e-7, D13 = -36.79e-7 (1/s)",
            "negative",
            f"{good.max_real_1_s:+.4g}",
            "stable" if good.stable else "unstable",
        ),
        _row("that D positive semidefinite", "implied", "yes" if passive(corrected) else "no", "passive"),
    ]
    units = [[_DAMPING_UNITS[unit] for unit in row] for row in entry_units(paper.PAPER_DOF)]
    return Section("The printed D is a misprint").add(
        page.matrix(printed, paper.PAPER_DOF, "D as printed, SI.", units=units),
        page.matrix(
            corrected,
            paper.PAPER_DOF,
            "D with both exponents -5 of the couplings read as -7, SI.",
            units=units,
        ),
        page.table(_HEADER, rows, words=True),
    )


def _modal() -> Section:
    paper_modes = modes(paper.PAPER_MASS, paper.PAPER_STIFFNESS, paper.PAPER_DAMPING_CORRECTED)
    rows = []
    for place, mode in enumerate(paper_modes.pairs):
        printed_ratio = paper.TABLE_2_DAMPING_RATIO[place]
        fits = abs(mode.damping_ratio - printed_ratio) < 0.005
        number = place + 1
        rows.append(
            _row(
                f"mode {number}: damped frequency (Hz)",
                f"{paper.TABLE_2_FREQUENCY_HZ[place]:g}",
                f"{mode.frequency_hz:.1f}",
                "agrees; Table 2 lists damped frequencies",
            )
        )
        rows.append(
            _row(
                f"mode {number}: undamped frequency (Hz)",
                "-",
                f"{mode.undamped_frequency_hz:.1f}",
                "|lambda|/2 pi",
            )
        )
        rows.append(
            _row(
                f"mode {number}: damping ratio",
                f"{printed_ratio:g}",
                f"{mode.damping_ratio:.3f}",
                _AGREES if fits else "the printed value does not follow from the matrices",
            )
        )
        shape = np.abs(mode.shape) * paper.TABLE_2_SHAPE_SCALE
        rows.append(
            _row(
                f"mode {number}: |phi| y, alpha, gamma",
                " ".join(f"{value:g}" for value in paper.TABLE_2_SHAPE[place]),
                " ".join(f"{value:.4g}" for value in shape),
                "agrees; not nm and microradian, but a scaled eigenvector",
            )
        )
    return Section("Modes: Table 2").add(
        page.table(_HEADER, rows, words=True),
        page.text(f"Shapes: {NORMALISATION}; times 1e9 for y and 1e6 for the rotations."),
        page.figure(shape_figure(paper_modes), _shape_caption(paper_modes), "mode shapes over the footplate"),
    )


def _shape_caption(mode_list: Modes) -> str:
    parts = []
    for place, mode in enumerate(mode_list.pairs):
        phases = np.degrees(np.angle(mode.shape))
        parts.append(f"mode {place + 1}: {', '.join(f'{value:+.0f}°' for value in phases)}")
    return (
        "Piston motion y - z alpha + x gamma of the footplate plane at the instant of largest motion and a "
        "quarter of a period later, each mode scaled to its own maximum, with the nodal line. Phases of y, "
        f"alpha, gamma: {'; '.join(parts)}."
    )


def _axes() -> Section:
    axes = principal_axes(paper.PAPER_STIFFNESS)
    mass = paper.PAPER_MASS
    values = (axes.origin_x_m * 1e3, axes.origin_z_m * 1e3)
    printed = paper.PAPER_PRINCIPAL_ORIGIN_MM
    rows = [
        _row("origin x0 = K13/K11 (mm)", f"{printed[0]:g} from the centre", f"{values[0]:+.4f}"),
        _row("origin z0 = -K12/K11 (mm)", f"{printed[1]:g} from the centre", f"{values[1]:+.4f}"),
        _row(
            "rotation about y (degrees)",
            f"{paper.PAPER_PRINCIPAL_ANGLE_DEG:g}",
            f"{np.degrees(axes.angle_rad):.3f}",
        ),
    ]
    names = ("stiffness y (N/m)", "about x' (N m/rad)", "about z' (N m/rad)")
    for name, was, now in zip(names, paper.PAPER_PRINCIPAL_STIFFNESS, axes.stiffness, strict=True):
        rows.append(_row(name, f"{was:g}", f"{now:.5g}"))
    piston = (paper.PAPER_STIFFNESS[0, 0], paper.PAPER_DAMPING_CORRECTED[0, 0])
    ring = ring_test(paper.PAPER_STIFFNESS, piston, 1j, ellipse_mm(*FOOTPLATE_MM))
    for name, value in zip(names[1:], () if ring is None else ring.rocking_ratio, strict=False):
        rows.append(_row(f"{name} over that of a uniform ring", "-", f"{value:.2f}", _RING))
    centre = (1e3 * mass[0, 2] / mass[0, 0], -1e3 * mass[0, 1] / mass[0, 0])
    return Section("Principal axes: Fig. 6").add(
        page.table(_HEADER, rows, words=True),
        page.text(
            "This is a shift to the stiffness centre and a rotation about y, not the eigenvectors of K, "
            "which depend on the units. The piston stiffness lies within the literature mean of "
            f"{paper.LITERATURE_PISTON_STIFFNESS[0]:g} ± {paper.LITERATURE_PISTON_STIFFNESS[1]:g} N/m."
        ),
        page.figure(
            principal_figure(axes.as_vector(), None, None, centre),
            "Principal axes of the paper's K, seen from lateral. Its footplate outline is not published.",
            "principal axes",
        ),
    )


def _simulate() -> Section:
    return Section("Simulated responses: Eq. 8, Figs. 4 and 5").add(
        page.figure(
            simulated_figure(),
            "Motion of the stapes by Eq. 8 with the corrected D for a base that moves along y with constant "
            f"velocity, scaled so that the largest |y| is the printed "
            f"{paper.PAPER_LARGEST_PISTON_M * 1e9:g} nm. The paper's measured base motion is not published.",
            "simulated responses",
        )
    )


def main(arguments: Sequence[str]) -> int:
    """Write the page to the path given; return the exit code."""
    return write_page("paper_page", arguments, lambda _: paper_page())


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
