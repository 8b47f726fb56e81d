"""Which ears make a cohort: none of them twice, all prepared and fitted in one way, fit for use."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.cohort.ears import Ear, unique_names
from stapeskit.faults import Fault
from stapeskit.warnings import Notice


def _measurement(ear: Ear) -> str:
    """Return what identifies the vibrometer files of an ear; its motion, where they are not recorded."""
    provenance = ear.kd.get("provenance") or {}
    if provenance.get("measured"):
        return " ".join(sorted(provenance["measured"].values()))
    return str(((provenance.get("inputs") or {}).get("motion") or {}).get("hash") or "")


def _subject_and_side(ear: Ear) -> tuple[str, str] | None:
    subject, side = str(ear.about.get("subject") or ""), ear.side or str(ear.about.get("side") or "")
    return (subject, side) if subject and side else None


def _body_of_scan(ear: Ear) -> str:
    """Return what identifies the body in a scan, which may hold several ears, each with its seed or box."""
    provenance = ear.mass.get("provenance") or {}
    scan = str(((provenance.get("inputs") or {}).get("scan") or {}).get("hash") or "")
    stated = provenance.get("parameters") or {}
    places = [f"{key} {stated[key]}" for key in ("seed_mm", "box_mm", "stapes_label") if stated.get(key)]
    return " ".join([scan, *places]) if scan else ""


_ONE_EAR: Mapping[str, Callable[[Ear], Hashable]] = {
    "the same folder": lambda ear: ear.folder,
    "the same measured motion": _measurement,
    "exactly the same K": lambda ear: str(ear.kd["stiffness_si"]),
    "the same identifier [study] ear": lambda ear: str(ear.about.get("ear", "")),
    "the same subject and side": _subject_and_side,
}
"""What two ears cannot have in common."""

_ALIKE: Mapping[str, Callable[[Ear], str]] = {
    "degrees of freedom": lambda ear: ",".join(ear.kd["dof"]),
    "estimator": lambda ear: str(ear.kd["estimator"]),
    "damping law": lambda ear: str((ear.kd.get("model") or {}).get("damping_law")),
    "cochlea": lambda ear: str(ear.about.get("cochlea", "")),
    "incus": lambda ear: str(ear.about.get("incus", "")),
}
"""What all ears must have in common."""


def cohort_faults(ears: Sequence[Ear]) -> list[Fault]:
    """Return every reason why ears are no cohort."""
    faults = [] if ears else [Fault("the cohort", "of at least one ear", "none")]
    names = dict(zip(map(id, ears), unique_names(ears), strict=True))
    reported: set[tuple[int, ...]] = set()
    for what, key in _ONE_EAR.items():
        for value, members in _groups(ears, key).items():
            places = tuple(map(id, members))
            if len(members) > 1 and value not in (None, "") and places not in reported:
                reported.add(places)
                listed = ", ".join(names[id(ear)] for ear in members)
                text, step = f"{what} in {listed}", "Leave one of them out, or correct their studies"
                faults.append(Fault("an ear", "in a cohort once", text, "", step))
    for ear in ears:
        stated = ear.about.get("side")
        if ear.side and stated not in (None, "", ear.side):
            thing, got = f"the side of {ear.name}", f"{stated} and {ear.side}"
            faults.append(Fault(thing, "the same in [study] and [scan]", got, ear.folder, "Correct one"))
    for what, key in _ALIKE.items():
        groups = _groups(ears, key)
        if len(groups) < 2:
            continue
        kinds = "; ".join(
            f"{value or 'not stated'}: {', '.join(names[id(ear)] for ear in them)}"
            for value, them in groups.items()
        )
        wanted, step = "the same in all ears of a cohort", "Make a cohort of each kind"
        faults.append(Fault(f"the {what}", wanted, kinds, "", step))
    return faults


def shared_scans(ears: Sequence[Ear]) -> list[Notice]:
    """Return a warning about ears whose masses come from one body of one scan."""
    found = []
    for value, members in _groups(ears, _body_of_scan).items():
        if value and len(members) > 1:
            listed = ", ".join(unique_names(members))
            text = (
                f"Ears with the same body of the same scan: {listed}. Either one ear is there more than "
                "once, or a study names the scan of another ear."
            )
            found.append(Notice("scan_shared", text))
    return found


def _groups(ears: Sequence[Ear], key: Callable[[Ear], Hashable]) -> dict[Any, list[Ear]]:
    """Return the ears by a key."""
    groups = defaultdict(list)
    for ear in ears:
        groups[key(ear)].append(ear)
    return groups


def reasons_to_exclude(ears: Sequence[Ear], use_all: bool = False) -> dict[str, str]:
    """Return, by folder, why an ear does not enter a law: no standard deviation, or its verdict.

    Parameters
    ----------
    use_all : bool
        Let ears enter whose verdict is "do not use".
    """
    reasons = {}
    for ear in ears:
        variances = dict(zip(ear.kd["parameters"], _diagonal(ear.kd.get("covariance_si")), strict=False))
        entries = {name: value for name, value in variances.items() if name[-1] == name[-2]}
        unknown = [name for name, value in entries.items() if not 0.0 < value < np.inf]
        inertia = _diagonal(ear.mass["inertial_parameters"].get("covariance_si"))
        unknown += [] if all(0.0 <= value < np.inf for value in inertia) else ["the mass"]
        if unknown or not entries:
            reasons[ear.folder] = f"no finite standard deviation of {', '.join(unknown) or 'K and D'}"
        elif ear.verdict == "do not use" and not use_all:
            causes = [reason["code"] for reason in ear.kd["verdict"].get("reasons") or []]
            reasons[ear.folder] = f"its verdict is: do not use ({', '.join(causes[:3])})"
    return reasons


def _diagonal(covariance: object) -> list[float]:
    return [] if covariance is None else [float(v) for v in np.diag(np.array(covariance, dtype=float))]
