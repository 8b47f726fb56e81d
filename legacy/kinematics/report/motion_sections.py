"""Report: the motion itself, at one frequency and over all of them, with its errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from legacy.kinematics.report.animation import moving_picture
from legacy.kinematics.report.draw_motion import (
    PHASES,
    Moment,
    chosen_line,
    moment,
    stroboscope_figure,
    surface_body,
)
from legacy.kinematics.report.draw_spectra import is_light, spectra_figure
from legacy.kinematics.report.stapes_surface import Scenery
from legacy.stapeskit.page import page
from legacy.stapeskit.page.page import Section
from legacy.stapeskit.spatial import DOF_UNITS

if TYPE_CHECKING:
    from markupsafe import Markup

    from legacy.kinematics.points2dof import Points2Dof

# Runs a figure, and figures a page.
_RUNS_A_FIGURE = 4
_MOST_FIGURES = 3


def moving_section(result: Points2Dof, scenery: Scenery, interactive: bool) -> Section:
    """Return the motion at one frequency: eight phases of a period, and with a script any frequency."""
    section = Section("Motion at one frequency", key="motion_at_one_frequency")
    run, line = chosen_line(result, scenery)
    now = moment(result, scenery, run, line)
    if interactive:
        section.add(moving_picture(result, now, scenery))
    section.add(
        page.figure(
            stroboscope_figure(result, now, scenery),
            _moment_words(result, now, scenery),
            f"Outlines and points of {', '.join(result.motion.bodies)} at {PHASES} phases, from three sides",
            dpi=150,
            vector=False,
            palette=True,
        )
    )
    return section


def _moment_words(result: Points2Dof, now: Moment, scenery: Scenery) -> str:
    motion = result.motion
    where = f"{motion.freq_hz[now.line]:.6g} Hz"
    if len(motion.runs) > 1:
        where += f", run {motion.runs[now.run]}"
    if motion.reference:
        unit = DOF_UNITS[motion.reference.rpartition(":")[2]]
        size = f"{now.largest_m:.3g} m per {unit} of {motion.reference}"
        scale = f"drawn as for {motion.reference} = {now.exaggeration * 1e3:.2g} m{unit}"
    else:
        small = now.largest_m < 1e-6
        size = f"{now.largest_m * (1e9 if small else 1e6):.3g} {'nm' if small else 'µm'} (peak)"
        scale = f"{now.exaggeration:,.0f} times larger than life"
    own = surface_body(motion.bodies)
    which = "the stapes" if own is not None and len(motion.bodies) > 1 else "the body"
    missing = ""
    if scenery.has_surface and own is None:
        missing = " The surface rests: none of the bodies is called stapes."
    return (
        f"{where}, where {which} moves most: {PHASES} phases of one period, {scale}; the largest "
        f"displacement drawn is {size}. Pale: at rest; dots: the points at the same phases.{missing}"
    )


def motion_section(result: Points2Dof) -> Section:
    """Return the spectra of the degrees of freedom and what shared errors do to them."""
    motion = result.motion
    section = Section("Motion of the rigid bodies", key="rigid_motion")
    per = f" per unit of {motion.reference}" if motion.reference else ""
    runs = len(motion.runs)
    groups = [tuple(range(k, min(k + _RUNS_A_FIGURE, runs))) for k in range(0, runs, _RUNS_A_FIGURE)]
    for number, group in enumerate(groups[:_MOST_FIGURES]):
        names = ", ".join(motion.runs[run] for run in group)
        where = f" Runs {names}." if runs > 1 else ""
        drawn = page.figure(
            spectra_figure(motion, group),
            f"Amplitude (peak displacement) and phase of the generalized coordinates{per} about the "
            f"footplate centre in footplate axes, e^{{+iωt}}; bands hold 95 % of the channel noise.{where}",
            f"Amplitude and phase over frequency of {', '.join(motion.dof)} of {', '.join(motion.bodies)}",
            vector=is_light(motion, len(group)),
            palette=True,
        )
        section.add(drawn if number == 0 else page.folded(f"Runs {names}", drawn))
    undrawn = runs - _RUNS_A_FIGURE * _MOST_FIGURES
    if undrawn > 0:
        section.add(page.text(f"The last {undrawn} runs are not drawn; the table of the motion has them."))
    if motion.shared is not None:
        section.add(page.subheading("Errors that all lines share"), _shared_table(result))
        section.add(
            page.text(
                "Change of each coordinate for one standard deviation of the source, root mean square over "
                "lines, of the rms of the motion. The bands do not contain these; they enter stiffness "
                "and damping as a whole."
            )
        )
    return section


def _shared_table(result: Points2Dof) -> Markup:
    """Return, per source, the relative change of each degree of freedom for one standard deviation."""
    motion = result.motion
    shared = motion.shared
    if shared is None:
        return page.text("None.")
    sources = list(dict.fromkeys(name.split(".")[0] for name in shared.names))
    rows = []
    for number, body in enumerate(motion.bodies):
        size = np.sqrt(np.nanmean(np.abs(motion.q[:, number]) ** 2, axis=(0, 1)))
        for source in sources:
            pick = [k for k, name in enumerate(shared.names) if name.startswith(source + ".")]
            d = shared.derivatives[pick][:, :, number]
            c = shared.covariance[np.ix_(pick, pick)]
            variance = np.real(np.einsum("arfd,ab,brfd->rfd", d.conj(), c, d, optimize=True))
            # Of exact data it is zero to rounding, of either sign.
            share = np.sqrt(np.maximum(np.nanmean(variance, axis=(0, 1)), 0.0)) / np.maximum(size, 1e-300)
            rows.append((body, source.replace("_", " "), *(f"{100.0 * value:.2g} %" for value in share)))
    return page.table(("body", "source", *motion.dof), rows, named_by=2)
