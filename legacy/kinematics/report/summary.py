"""The result of a fit of motion in a few rows, for terminal and notebook, and as JSON for each body."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from legacy.kinematics.points2dof import Points2Dof
from legacy.kinematics.report import geometry_report
from legacy.stapeskit.page.drawings import line_words
from legacy.stapeskit.records.motion_files import standard_deviation

# Rows of the summary, which fits one screen.
_MOST_BODIES = 6
_MOST_INPUTS = 4


def summary_rows(result: Points2Dof) -> list[tuple[str, str]]:
    """Return degrees of freedom, lines, fit of every body, verdicts, registration and repeats."""
    motion = result.motion
    per = f" per {motion.reference}" if motion.reference else ""
    several = len(motion.runs) > 1
    rows = [
        ("degrees of freedom", ", ".join(motion.dof) + per),
        ("lines", f"{line_words(motion.freq_hz)}, {len(motion.runs)} run{'s' if several else ''}"),
    ]
    rows += [("input", text) for text in result.measurement.said[:_MOST_INPUTS]]
    ratios = _best_ratios(result)
    for name, body in bodies_json(result).items():
        chi2, n_dof = body["chi2"], body["n_dof"]
        text = f"{body['channels']} channels, "
        text += f"chi2/dof {chi2 / n_dof:.3g}" if n_dof else "no redundancy"
        if ratios[name] > 0.0:
            text += f", best peak/noise {ratios[name]:.3g}"
        rows.append((name, text))
        if body["unobservable"]:
            rows.append((f"{name} not seen", "; ".join(body["unobservable"])))
    counts = Counter(channel.verdict for channel in result.channels)
    rows.append(("channels", ", ".join(f"{number} {name}" for name, number in counts.most_common())))
    rows += geometry_report.rows(result)
    rows += [
        (f"repeats of {repeats.run}" if several else "repeats", repeats.summary) for repeats in result.repeats
    ]
    return rows


def bodies_json(result: Points2Dof) -> dict[str, dict[str, Any]]:
    """Return channels, chi2 and unobservable motions of the first bodies, by name."""
    motion = result.motion
    return {
        name: {
            "channels": len(result.measurement.bodies[number].points),
            "chi2": float(np.nansum(motion.chi2[:, number])),
            "n_dof": int(np.sum(motion.n_dof[:, number])),
            "unobservable": list(result.unseen.get(name, ())),
        }
        for number, name in enumerate(motion.bodies[:_MOST_BODIES])
    }


def _best_ratios(result: Points2Dof) -> dict[str, float]:
    """Return the largest amplitude over its rms noise among the degrees of freedom, by body; 0: no noise."""
    motion, sd = result.motion, standard_deviation(result.motion)
    ratios = {}
    for number, name in enumerate(motion.bodies[:_MOST_BODIES]):
        size = np.nanmax(np.abs(motion.q[:, number]), axis=(0, 1))
        known = np.isfinite(sd[:, number])
        power = np.sum(np.where(known, sd[:, number], 0.0) ** 2, axis=(0, 1))
        noise = np.sqrt(power / np.maximum(np.sum(known, axis=(0, 1)), 1))
        some = noise > 0.0
        ratios[name] = float(np.max(size[some] / noise[some])) if np.any(some) else 0.0
    return ratios
