"""Which ears make a cohort: none of them twice, all prepared and fitted in one way, fit for use."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Hashable, Sequence

import numpy as np

from pipeline.cohort.ears import Ear
from stapeskit.faults import Fault
from stapeskit.warnings import Notice

_LEAVE_OUT = "Leave one of them out"


def cohort_faults(ears: Sequence[Ear], mix: bool = False) -> list[Fault]:
    """Return every reason why ears are no cohort.

    Parameters
    ----------
    mix : bool
        Allow different estimators, damping laws and states of cochlea and incus.
    """
    return [*_repeated_ears(ears), *_contradicting_sides(ears), *_differences(ears, mix)]


def reasons_to_exclude(ears: Sequence[Ear], use_all: bool = False) -> dict[str, str]:
    """Return, by folder, why an ear does not enter a law: no standard deviation, or its verdict.

    Parameters
    ----------
    use_all : bool
        Let ears enter whose verdict is "do not use".
    """
    reasons = {}
    for ear in ears:
        diagonal = zip(ear.kd["parameters"], _diagonal(ear.kd.get("covariance_si")), strict=False)
        entries = {name: variance for name, variance in diagonal if name[-1] == name[-2]}
        unknown = [name for name, variance in entries.items() if not 0.0 < variance < float("inf")]
        inertia = _diagonal(ear.mass["inertial_parameters"].get("covariance_si") or [[1.0]])
        if not all(0.0 <= variance < float("inf") for variance in inertia):
            unknown.append("the mass")
        if unknown or not entries:
            reasons[ear.folder] = f"no finite standard deviation of {', '.join(unknown) or 'K and D'}"
        elif ear.verdict == "do not use" and not use_all:
            causes = [reason["code"] for reason in ear.kd["verdict"].get("reasons") or []]
            reasons[ear.folder] = f"its verdict is: do not use ({', '.join(causes[:3])})"
    return reasons


def _diagonal(covariance: object) -> list[float]:
    if covariance is None:
        return []
    return [float(value) for value in np.diag(np.array(covariance, dtype=float))]


def _repeated_ears(ears: Sequence[Ear]) -> list[Fault]:
    """Return a fault for each way in which an ear is there more than once."""
    times = Counter(ear.folder for ear in ears)
    twice = [folder for folder, count in times.items() if count > 1]
    faults = [Fault("an ear", "in a cohort once", f"{folder} twice", "", _LEAVE_OUT) for folder in twice]
    alike: dict[str, list[Hashable]] = {
        "the same measured motion": [_measurement(ear) for ear in ears],
        "exactly the same K": [str(ear.kd["stiffness_si"]) for ear in ears],
        "the same identifier [study] ear": [str(ear.about.get("ear", "")) for ear in ears],
        "the same subject and side": [_subject_and_side(ear) for ear in ears],
    }
    reported: set[frozenset[str]] = set()
    for what, keys in alike.items():
        for members in _groups(ears, keys):
            names = frozenset(ear.folder for ear in members)
            if len(names) > 1 and names not in reported:
                reported.add(names)
                listed = ", ".join(f"{ear.name} ({ear.folder})" for ear in members)
                faults.append(Fault("an ear", "in a cohort once", f"{what} in {listed}", "", _LEAVE_OUT))
    return faults


def _groups(ears: Sequence[Ear], keys: Sequence[Hashable]) -> list[list[Ear]]:
    """Return the ears that share a key; empty keys count for nothing."""
    groups = defaultdict(list)
    for ear, key in zip(ears, keys, strict=True):
        if key not in (None, ""):
            groups[key].append(ear)
    return [members for members in groups.values() if len(members) > 1]


def shared_scans(ears: Sequence[Ear]) -> list[Notice]:
    """Return a warning about ears whose masses come from one body of one scan."""
    shared = _groups(ears, [_scan(ear) for ear in ears])
    if not shared:
        return []
    listed = "; ".join(", ".join(f"{ear.name} ({ear.folder})" for ear in members) for members in shared)
    text = (
        f"Ears with the same body of the same scan: {listed}. Either one ear is there more than once, or a "
        "study names the scan of another ear."
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


def _subject_and_side(ear: Ear) -> tuple[str, str] | None:
    subject = str(ear.about.get("subject") or "")
    side = ear.side or str(ear.about.get("side") or "")
    return (subject, side) if subject and side else None


def _contradicting_sides(ears: Sequence[Ear]) -> list[Fault]:
    step = "Correct the wrong one"
    return [
        Fault(
            f"the side of {ear.name}",
            "the same in [study] and [scan]",
            f"{ear.about['side']} and {ear.side}",
            ear.folder,
            step,
        )
        for ear in ears
        if ear.side and ear.about.get("side") not in (None, "", ear.side)
    ]


def _differences(ears: Sequence[Ear], mix: bool) -> list[Fault]:
    """Return a fault for everything that must be the same in all ears and is not."""
    checks = {"degrees of freedom": [",".join(ear.kd["dof"]) for ear in ears]}
    if not mix:
        checks |= {
            "estimator": [str(ear.kd["estimator"]) for ear in ears],
            "damping law": [str((ear.kd.get("model") or {}).get("damping_law")) for ear in ears],
            "cochlea": [str(ear.about.get("cochlea", "")) for ear in ears],
            "incus": [str(ear.about.get("incus", "")) for ear in ears],
        }
    faults = []
    for what, values in checks.items():
        if len(set(values)) < 2:
            continue
        groups = defaultdict(list)
        for ear, value in zip(ears, values, strict=True):
            groups[value or "not stated"].append(ear.name)
        listed = "; ".join(f"{value}: {', '.join(names)}" for value, names in groups.items())
        step = "Make a cohort of each kind"
        if what != "degrees of freedom":
            step += ", or allow a mixed one with --mix"
        faults.append(Fault(f"the {what}", "the same in all ears of a cohort", listed, "", step))
    return faults
