"""Which ears make a cohort: none of them twice, all prepared and fitted in one way."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Hashable, Sequence

import numpy as np

from legacy.pipeline.cohort.compare_ears import Ear
from legacy.stapeskit.faults import Fault
from legacy.stapeskit.warnings import Notice

_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_LEAVE_OUT = "Leave one of them out"


def faults_of_cohort(ears: Sequence[Ear], mix: bool = False) -> list[Fault]:
    """Return every reason why ears are no cohort.

    Parameters
    ----------
    mix : bool
        Allow different estimators, damping laws and states of cochlea and incus.
    """
    return [*_repeated_ears(ears), *_contradicting_sides(ears), *_differences(ears, mix)]


def ears_without_sd(ears: Sequence[Ear]) -> dict[str, str]:
    """Return, by folder, why an ear cannot enter a law: K, D or mass have no finite standard deviation."""
    reasons = {}
    for ear in ears:
        entries = [*zip(ear.kd["parameters"], _diagonal(ear.kd.get("covariance_si")), strict=False)]
        unknown = [
            name for name, variance in entries if name[-1] == name[-2] and not 0.0 < variance < float("inf")
        ]
        inertia = _diagonal(ear.mass["inertial_parameters"].get("covariance_si") or [[1.0]])
        if not all(0.0 <= variance < float("inf") for variance in inertia):
            unknown.append("the mass")
        if unknown or not entries:
            listed = ", ".join(unknown) or "K and D"
            reasons[ear.folder] = f'no finite standard deviation of {listed}; fit it with estimator = "ml"'
    return reasons


def _diagonal(covariance: object) -> list[float]:
    if covariance is None:
        return []
    matrix = np.array(covariance, dtype=float)
    return [float(value) for value in np.diag(matrix)]


def _repeated_ears(ears: Sequence[Ear]) -> list[Fault]:
    """Return a fault for each way in which an ear is there more than once."""
    faults = [
        Fault("an ear", "in a cohort once", f"{folder} twice", "", _LEAVE_OUT)
        for folder, count in Counter(ear.folder for ear in ears).items()
        if count > 1
    ]
    alike: list[tuple[str, list[Hashable]]] = [
        ("the same measured motion", [_measurement(ear) for ear in ears]),
        ("exactly the same K", [str(ear.kd["stiffness_si"]) for ear in ears]),
        ("the same identifier [study] ear", [str(ear.about.get("ear", "")) for ear in ears]),
        ("the same subject and side", [_subject_side(ear) for ear in ears]),
    ]
    reported: set[frozenset[str]] = {frozenset()}
    for what, keys in alike:
        groups = defaultdict(list)
        for ear, key in zip(ears, keys, strict=True):
            if key not in (None, ""):
                groups[key].append(ear)
        for members in groups.values():
            names = frozenset(ear.folder for ear in members)
            if len(names) > 1 and names not in reported:
                reported.add(names)
                listed = ", ".join(f"{ear.name} ({ear.folder})" for ear in members)
                faults.append(Fault("an ear", "in a cohort once", f"{what} in {listed}", "", _LEAVE_OUT))
    return faults


def shared_scans(ears: Sequence[Ear]) -> list[Notice]:
    """Return a warning about ears whose masses come from one body of one scan."""
    groups = defaultdict(list)
    for ear in ears:
        if key := _scan(ear):
            groups[key].append(ear)
    shared = [members for members in groups.values() if len(members) > 1]
    if not shared:
        return []
    listed = "; ".join(", ".join(f"{ear.name} ({ear.folder})" for ear in members) for members in shared)
    text = (
        f"Ears with the same body of the same scan: {listed}. Either one ear is there more than once, or a "
        f"study names the scan of another ear."
    )
    return [Notice("scan_shared", text)]


def _measurement(ear: Ear) -> str:
    """Return what identifies the vibrometer files of an ear; its motion, where they are not recorded."""
    provenance = ear.kd.get("provenance") or {}
    measured = provenance.get("measured")
    if measured:
        return " ".join(sorted(measured.values()))
    return str(((provenance.get("inputs") or {}).get("motion") or {}).get("hash") or "")


def _scan(ear: Ear) -> str:
    """Return what identifies the body in a scan, which may hold several ears, each with its seed or box."""
    provenance = ear.mass.get("provenance") or {}
    scan = str(((provenance.get("inputs") or {}).get("scan") or {}).get("hash") or "")
    stated = provenance.get("parameters") or {}
    places = [f"{key} {stated[key]}" for key in ("seed_mm", "box_mm", "stapes_label") if stated.get(key)]
    return " ".join([scan, *places]) if scan else ""


def _subject_side(ear: Ear) -> tuple[str, str] | None:
    subject = str(ear.about.get("subject") or "")
    side = _side(ear.side or ear.about.get("side"))
    return (subject, side) if subject and side else None


def _side(stated: object) -> str:
    return _SIDES.get(str(stated or "").strip().lower(), "")


def _contradicting_sides(ears: Sequence[Ear]) -> list[Fault]:
    return [
        Fault(
            f"the side of {ear.name}",
            "the same in [study] and [scan]",
            f"{ear.about['side']} and {ear.side}",
            ear.folder,
            "Correct the wrong one",
        )
        for ear in ears
        if ear.side and _side(ear.about.get("side")) not in ("", _side(ear.side))
    ]


def _differences(ears: Sequence[Ear], mix: bool) -> list[Fault]:
    """Return a fault for everything that must be the same in all ears and is not."""
    checks: list[tuple[str, list[str]]] = [
        ("degrees of freedom", [",".join(ear.kd["dof"]) for ear in ears]),
    ]
    if not mix:
        checks += [
            ("estimator", [str(ear.kd["estimator"]) for ear in ears]),
            ("damping law", [str(ear.kd["model"].get("damping_law")) for ear in ears]),
            ("cochlea", [str(ear.about.get("cochlea", "")) for ear in ears]),
            ("incus", [str(ear.about.get("incus", "")) for ear in ears]),
        ]
    faults = []
    for what, values in checks:
        if len(set(values)) < 2:
            continue
        groups = defaultdict(list)
        for ear, value in zip(ears, values, strict=True):
            groups[value or "not stated"].append(ear.name)
        listed = "; ".join(f"{value}: {', '.join(names)}" for value, names in groups.items())
        step = "Make a cohort of each kind"
        if what != "degrees of freedom":
            step += ", or allow a mixed one with {mix}"
        faults.append(Fault(f"the {what}", "the same in all ears of a cohort", listed, "", step))
    return faults
