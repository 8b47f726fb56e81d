"""Report: what does not fit a rigid motion, how sure that is, and what to do about it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from legacy.kinematics.faults.catalogue import ADVICE
from legacy.kinematics.measurement import direction_name
from legacy.kinematics.report.detectable_sections import detectable_blocks
from legacy.kinematics.report.draw_residuals import relative_rms, residual_figure
from legacy.kinematics.report.draw_spectra import chi2_figure
from legacy.stapeskit.option_names import written
from legacy.stapeskit.page import page
from legacy.stapeskit.page.page import Section

if TYPE_CHECKING:
    from markupsafe import Markup

    from legacy.kinematics.faults.verdicts import ChannelVerdict
    from legacy.kinematics.measurement import BodyChannels
    from legacy.kinematics.points2dof import Points2Dof

# Maps and rows of a page; the channels table holds all.
_MOST_MAPS = 4
_MOST_ROWS = 2000


@dataclass(frozen=True)
class Group:
    """Channels of one body and run that share one verdict.

    Attributes
    ----------
    verdict : ChannelVerdict
        Of the first of them.
    names : tuple of str
        Of the channels: the point, its beams, and the direction of a single beam.
    excess : float
        How much larger their summed squared residual is than noise would make it, in units of sd^2.
    rms : float
        Largest root mean square residual, in units of sd; NaN when unused.
    """

    verdict: ChannelVerdict
    names: tuple[str, ...]
    excess: float
    rms: float


def groups_of(result: Points2Dof) -> list[Group]:
    """Return the verdicts other than ok, the most severe first: by their residual beyond noise."""
    groups = []
    for run, run_name in enumerate(result.motion.runs):
        for number, body in enumerate(result.measurement.bodies):
            own = [v for v in result.channels if v.run == run_name and v.body == body.body]
            faults: dict[tuple[str, str], list[int]] = {}
            for channel, verdict in enumerate(own):
                if verdict.verdict != "ok":
                    faults.setdefault((verdict.verdict, verdict.estimate), []).append(channel)
            if not faults:
                continue
            fit = result.fits[run, number]
            rms, lines = relative_rms(fit), fit.solution.used
            for channels in faults.values():
                size = rms[channels]
                excess = float(np.nansum(2.0 * lines[channels] * (size**2 - 1.0)))
                worst = float(np.nanmax(size)) if np.any(np.isfinite(size)) else float("nan")
                groups.append(Group(own[channels[0]], _names(body, own, channels), excess, worst))
    return sorted(groups, key=lambda group: (np.isnan(group.rms), -group.excess))


def verdict_section(result: Points2Dof) -> Section:
    """Return the table of verdicts, the most severe first, and all channels behind a fold."""
    section = Section("Verdict on every channel", key="verdicts")
    counts = Counter(v.verdict for v in result.channels)
    counted = ", ".join(f"{number} {name}" for name, number in counts.most_common())
    section.add(page.text(f"{channel_count(result)}: {counted}."))
    groups = groups_of(result)
    several = len(result.motion.runs) > 1
    if groups:
        header = ("body", "channels", "verdict", "estimate", "residual (rms / sd)", "p-value", "what to do")
        rows = [_fault_row(group, several) for group in groups]
        section.add(page.table((*(("run",) if several else ()), *header), rows, words=True))
        section.add(
            page.text(
                "The most severe first: by how much the squared residual exceeds that of noise. The p-value "
                "is the probability of such evidence by chance, corrected for the number of tests."
            )
        )
    else:
        section.add(page.text(clean_words(result)))
    section.add(*detectable_blocks(result))
    section.add(page.folded("All channels", *_all_channels(result)))
    if groups and not result.corrections:
        section.add(
            page.text(
                written(
                    "Channels with a verdict stay in the fit unless they read zero or hold nothing: correct "
                    "them and run again, or let {correct} do it."
                )
            )
        )
    return section


def clean_words(result: Points2Dof) -> str:
    """State that no channel is an outlier, and whether all residuals exceed the stated noise."""
    codes = {notice.code for notice in result.notices}
    if "noise_level" in codes:
        return (
            "No channel is an outlier, but all deviate by more than their stated noise (warning noise_level)."
        )
    if "neglected_motion" in codes:
        return "None is significant; the warning neglected_motion reports motion that the fit leaves out."
    return "Every one agrees with the rigid motion of its body within its noise."


def channel_count(result: Points2Dof) -> str:
    """Return how many channels were judged, in words."""
    runs = len(result.motion.runs)
    count = sum(len(body.points) for body in result.measurement.bodies)
    return f"{count} channels in each of {runs} runs" if runs > 1 else f"{count} channels"


def _fault_row(group: Group, several: bool) -> tuple[str, ...]:
    v = group.verdict
    size = "not used" if np.isnan(group.rms) else f"{group.rms:.3g}"
    row = (
        v.body,
        _join_names(group.names),
        v.verdict,
        plus_minus(v.estimate) or "-",
        size,
        chance(v.p_value),
    )
    return (*((v.run,) if several else ()), *row, _step(v))


def _step(verdict: ChannelVerdict) -> str:
    """Return what to do about a verdict."""
    return f"{verdict.step}." if verdict.step else written(ADVICE[verdict.verdict][1])


def _join_names(names: Sequence[str], most: int = 6) -> str:
    words = "; ".join(names[:most])
    return f"{words}; and {len(names) - most} more" if len(names) > most else words


def _names(body: BodyChannels, own: Sequence[ChannelVerdict], channels: Sequence[int]) -> tuple[str, ...]:
    """Name channels by point; of a point with several beams say which of them, in the order of the file."""
    names = []
    for point in dict.fromkeys(body.points[c] for c in channels):
        beams = [c for c, name in enumerate(body.points) if name == point]
        mine = [c for c in channels if body.points[c] == point]
        if len(mine) == len(beams):
            names.append(point if len(beams) == 1 else f"{point}, all {len(beams)} beams")
            continue
        which = ", ".join(str(beams.index(c) + 1) for c in mine)
        where = f" ({direction_name(own[mine[0]].direction)})" if len(mine) == 1 else ""
        names.append(f"{point}, beam{'s' if len(mine) > 1 else ''} {which}{where}")
    return tuple(names)


def plus_minus(estimate: str) -> str:
    """Write the estimate of a verdict for people."""
    return estimate.replace(" +- ", " ± ")


def chance(p: float) -> str:
    """Write a probability; one that is not known is a dash."""
    if np.isnan(p):
        return "-"
    words = "<\u00a01e-300" if p < 1e-300 else f"{p:.2g}"
    return words.replace("-", "\u2212")


def _all_channels(result: Points2Dof) -> list[Markup]:
    header = ("run", "body", "point", "beam", "residual rms (nm)", "weight", "verdict", "estimate", "p-value")
    rows = [
        (
            v.run, v.body, v.point, direction_name(v.direction), _number(v.residual_rms_m * 1e9),
            f"{v.weight:.3g}", v.verdict, plus_minus(v.estimate), chance(v.p_value),
        )
        for v in result.channels[:_MOST_ROWS]
    ]  # fmt: skip
    blocks = [page.table(header, rows)]
    if len(result.channels) > _MOST_ROWS:
        blocks.append(page.text(f"The other {len(result.channels) - _MOST_ROWS} are in the channels table."))
    blocks.append(
        page.text(
            "The p-value of a channel that is ok is the chance of so large a residual, without correction."
        )
    )
    return blocks


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.3g}"


def residual_section(result: Points2Dof) -> Section:
    """Return the residual maps, chi2 over frequency and the rigidity tests."""
    section = Section("Residuals of the rigid fit", key="rigid_residuals")
    runs = _worst_runs(result)
    for run in runs:
        drawing, residuals = residual_figure(result, run)
        several = len(result.motion.runs) > 1
        shared = (
            f" Each column is the largest of up to {residuals.lines} lines." if residuals.lines > 1 else ""
        )
        where = f", run {result.motion.runs[run]}" if several else ""
        section.add(
            page.figure(
                drawing,
                f"|residual| of every channel over frequency in units of its sd{where}.{shared} Noise "
                f"alone gives about {residuals.noise:.2g}. Grey: not used. Bars: root mean square over "
                "frequency in units of sd, corrected for leverage: 1 for noise. Red: channels with a "
                "verdict.",
                f"Residual map{where}: {_map_words(result, run)}",
                dpi=110,
                vector=False,
                palette=True,
            )
        )
    if len(result.motion.runs) > len(runs):
        section.add(
            page.text(
                f"{len(runs)} of {len(result.motion.runs)} runs drawn: those with a verdict, or else the one "
                "with the largest chi2."
            )
        )
    if np.any(result.motion.n_dof > 0):
        shown = tuple(sorted(runs))
        section.add(
            page.figure(
                chi2_figure(result.motion, shown),
                "chi2 per degree of freedom at every line; dashed: the range that holds 95 % of the lines "
                "of a rigid body with the stated noise.",
                "chi2 per degree of freedom over frequency for every body",
                vector=len(result.motion.freq_hz) * len(shown) <= 2000,
                palette=True,
            )
        )
    section.add(_chi2_table(result))
    return section


def _worst_runs(result: Points2Dof) -> list[int]:
    """Return the runs whose maps are drawn: those with verdicts, else the one with the largest chi2."""
    wrong = {v.run for v in result.channels if v.verdict != "ok"}
    chi2 = np.nansum(result.motion.chi2, axis=(1, 2))
    order = np.argsort(-chi2, kind="stable").tolist()
    named = [run for run in order if result.motion.runs[run] in wrong]
    return sorted((named or order[:1])[:_MOST_MAPS])


def _map_words(result: Points2Dof, run: int) -> str:
    name = result.motion.runs[run]
    wrong = sum(1 for v in result.channels if v.run == name and v.verdict != "ok")
    total = sum(1 for v in result.channels if v.run == name)
    return f"{total} channels, {wrong} with a verdict"


def _chi2_table(result: Points2Dof) -> Markup:
    from scipy.special import chdtrc

    rows = []
    motion = result.motion
    for run, run_name in enumerate(motion.runs):
        for number, body in enumerate(motion.bodies):
            good = np.isfinite(motion.chi2[run, number]) & (motion.n_dof[run, number] > 0)
            chi2 = float(np.sum(motion.chi2[run, number][good]))
            n_dof = int(np.sum(motion.n_dof[run, number][good]))
            p = float(chdtrc(n_dof, chi2)) if n_dof else float("nan")
            rows.append((run_name, body, f"{chi2:.6g}", n_dof, f"{chi2 / max(n_dof, 1):.3g}", chance(p)))
    return page.table(
        ("run", "body", "chi2", "degrees of freedom", "ratio", "p-value of a rigid body"), rows, named_by=2
    )
