"""Every kind of fault in every channel and point of the sample study: is it found, and named?

    python benchmarks/points_sample.py

Every channel of both bodies in turn reads 5 % too much, with the opposite sign, zero, conjugated, with five
times its noise, with a sensitivity that drifts by 10 %, from a beam 10 degrees off, or with two lines
exchanged. Every point in turn lies 200 um off, is conjugated, lists its lines one too late, is exchanged with
every other point of its body and with one of the other body, has two of its beams exchanged, or is listed
under the other body. In a second recording with another shaker axis the runs of every point are exchanged.
Position errors of the stated size are in the data. The last column is the power of the most powerful test of
that very fault, place and size known (Neyman and Pearson 1933): its mean over the cases that were not named.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations, islice
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.points2dof import points2dof
from legacy.stapeskit.frames import RigidTransform, rotation_from_vector

SAMPLE = Path(__file__).resolve().parents[1] / "sample_volumes"
ALARM = 0.01
Change = Callable[[BodyChannels, list[int], np.random.Generator], BodyChannels]


@dataclass(frozen=True)
class Case:
    """A recording with one fault, its culprits (body, channel), and the verdict they deserve."""

    data: Measurement
    culprits: frozenset[tuple[int, int]]
    verdict: str
    name: str


def sample(second_run: bool = False) -> Measurement:
    """Return the recording of the sample study about the middle of its points; with a second run of its kind.

    The motion of the second run is that of the first, its degrees of freedom mixed: another shaker axis.
    """
    from legacy.kinematics.readers.measurement_files import read_measurement

    data = read_measurement((SAMPLE / "ldv.csv",), SAMPLE / "points.csv", "vibrometer")
    middle = np.mean(np.concatenate([body.positions_mm for body in data.bodies]), axis=0)
    data = data.mapped(RigidTransform.from_parts(np.eye(3), -middle, "footplate", "vibrometer"))
    if not second_run:
        return data
    bodies = []
    for body in data.bodies:
        rng = np.random.default_rng([len(body.points), 5])
        rows = _rows(body)
        q = np.linalg.lstsq(rows, body.displacement[0], rcond=None)[0]
        mixed = np.array([q[1], q[2], q[0], q[5], q[3], q[4]]) * np.exp(0.5j)
        noise = rng.normal(size=(*body.displacement[0].shape, 2)) @ np.array([1.0, 1j])
        other = rows @ mixed + np.asarray(body.sd)[0] * noise
        sd = np.concatenate([np.asarray(body.sd)] * 2)
        bodies.append(replace(body, displacement=np.stack([body.displacement[0], other]), sd=sd))
    return replace(data, runs=("1", "2"), bodies=tuple(bodies))


def _rows(body: BodyChannels) -> NDArray[np.float64]:
    return np.hstack([body.directions, np.cross(body.positions_mm * 1e-3, body.directions)])


def _value(change: Callable[[NDArray[np.complex128]], NDArray[np.complex128]]) -> Change:
    def made(body: BodyChannels, own: list[int], _rng: np.random.Generator) -> BodyChannels:
        value = body.displacement.copy()
        value[:, own] = change(value[:, own])
        return replace(body, displacement=value)

    return made


def _noisy(body: BodyChannels, own: list[int], rng: np.random.Generator) -> BodyChannels:
    value = body.displacement.copy()
    noise = rng.normal(size=(*value[:, own].shape, 2)) @ np.array([1.0, 1j])
    value[:, own] += np.sqrt(24.0) * np.asarray(body.sd)[:, own] * noise
    return replace(body, displacement=value)


def _turn(body: BodyChannels, own: list[int], rng: np.random.Generator) -> BodyChannels:
    directions = body.directions.copy()
    axis = np.cross(directions[own[0]], rng.normal(size=3))
    turn = rotation_from_vector(np.radians(10.0) * axis / np.linalg.norm(axis))
    directions[own[0]] = turn @ directions[own[0]]
    return replace(body, directions=directions)


def _move(body: BodyChannels, own: list[int], rng: np.random.Generator) -> BodyChannels:
    shift = rng.normal(size=3)
    positions = body.positions_mm.copy()
    positions[own] += 0.2 * shift / np.linalg.norm(shift)
    return replace(body, positions_mm=positions)


def _late(value: NDArray[np.complex128]) -> NDArray[np.complex128]:
    return np.concatenate([np.full_like(value[..., :1], np.nan), value[..., :-1]], axis=-1)


def _two_lines(value: NDArray[np.complex128]) -> NDArray[np.complex128]:
    exchanged = value.copy()
    exchanged[..., [30, 150]] = value[..., [150, 30]]
    return exchanged


def _drift(value: NDArray[np.complex128]) -> NDArray[np.complex128]:
    return np.asarray(value * np.linspace(1.0, 1.1, value.shape[-1]))


CHANNEL: dict[str, tuple[Change, str]] = {
    "gain 5 %": (_value(lambda v: 1.05 * v), "gain"),
    "sign": (_value(np.negative), "sign"),
    "zeros": (_value(np.zeros_like), "zeros"),
    "noise x 5": (_noisy, "noise"),
    "drift 10 %": (_value(_drift), "drift"),
    "direction 10 deg": (_turn, "direction"),
    "conjugate": (_value(np.conj), "sign"),
    "two lines exchanged": (_value(_two_lines), "label_swap"),
}
POINT: dict[str, tuple[Change, str]] = {
    "point 200 um off": (_move, "position"),
    "point conjugated": (_value(np.conj), "sign"),
    "point one line late": (_value(_late), "label_swap"),
    "runs of a point": (_value(lambda v: v[::-1]), "label_swap"),
}
PAIRS = ("points exchanged", "beams exchanged")
ACROSS = ("bodies exchanged", "listed under the other")
KINDS = (*CHANNEL, *POINT, *PAIRS, *ACROSS)


def channels_of(body: BodyChannels) -> dict[str, list[int]]:
    """Return the channels of every point."""
    return {name: [c for c, own in enumerate(body.points) if own == name] for name in body.points}


def cases(data: Measurement, number: int, kind: str, seed: int) -> Iterator[Case]:
    """Yield the recordings with one kind of fault, at every place of a body."""
    body, points = data.bodies[number], channels_of(data.bodies[number])

    def case(changed: BodyChannels, own: list[int], verdict: str, name: str) -> Case:
        bodies = list(data.bodies)
        bodies[number] = replace(changed, reported_directions=body.reported_directions)
        culprits = frozenset((number, c) for c in own)
        return Case(replace(data, bodies=tuple(bodies)), culprits, verdict, name)

    if kind in CHANNEL:
        change, verdict = CHANNEL[kind]
        for c in range(len(body.points)):
            rng = np.random.default_rng([seed, c, 61])
            yield case(change(body, [c], rng), [c], verdict, body.channel_name(c))
    elif kind in POINT:
        change, verdict = POINT[kind]
        for name, own in points.items():
            changed = change(body, own, np.random.default_rng([seed, own[0], 61]))
            yield case(changed, own, verdict, name)
    elif kind == "points exchanged":
        for first, second in combinations(points, 2):
            positions = body.positions_mm.copy()
            positions[points[first]] = body.positions_mm[points[second][0]]
            positions[points[second]] = body.positions_mm[points[first][0]]
            own = sorted(points[first] + points[second])
            yield case(replace(body, positions_mm=positions), own, "label_swap", f"{first} and {second}")
    elif kind == "beams exchanged":
        for name, own in points.items():
            for c, d in combinations(own, 2):
                value, sd = body.displacement.copy(), np.array(body.sd)
                value[:, [c, d]], sd[:, [c, d]] = value[:, [d, c]], sd[:, [d, c]]
                changed = replace(body, displacement=value, sd=sd)
                yield case(changed, [c, d], "label_swap", f"{name}, beams {c} and {d}")
    else:
        yield from _across(data, number, kind)


def _across(data: Measurement, number: int, kind: str) -> Iterator[Case]:
    first, second = data.bodies[number], data.bodies[1 - number]
    others = list(channels_of(second).values())
    for k, (name, own) in enumerate(channels_of(first).items()):
        bodies = [first, second]
        if kind == "bodies exchanged":
            partner = others[(2 * k + 1) % len(others)]
            for place, (mine, theirs, i, j) in enumerate(
                ((first, second, own, partner), (second, first, partner, own))
            ):
                value, sd = mine.displacement.copy(), np.array(mine.sd)
                value[:, i], sd[:, i] = theirs.displacement[:, j], np.asarray(theirs.sd)[:, j]
                bodies[place] = replace(mine, displacement=value, sd=sd)
            culprits = {(number, c) for c in own} | {(1 - number, c) for c in partner}
        else:
            rest = [c for c in range(len(first.points)) if c not in own]
            bodies = [
                _pick([(first, rest)], first.body, ""),
                _pick([(second, []), (first, own)], second.body, name),
            ]
            culprits = {(1 - number, len(second.points) + c) for c in range(len(own))}
        ordered = tuple(bodies if number == 0 else bodies[::-1])
        yield Case(replace(data, bodies=ordered), frozenset(culprits), "label_swap", f"{first.body} {name}")


def _pick(parts: list[tuple[BodyChannels, list[int]]], name: str, extra: str) -> BodyChannels:
    """Join channels of bodies, all of them when none are listed; those of a second one under another name."""
    whole = [(body, own or list(range(len(body.points)))) for body, own in parts]

    def joined(what: str, axis: int) -> NDArray[np.float64]:
        held = [np.take(np.asarray(getattr(body, what)), own, axis=axis) for body, own in whole]
        return np.concatenate(held, axis=axis)

    points = [
        body.points[c] if k == 0 else f"extra {extra}" for k, (body, own) in enumerate(whole) for c in own
    ]
    return BodyChannels(
        name,
        tuple(points),
        joined("positions_mm", 0),
        joined("directions", 0),
        joined("displacement", 1).astype(complex),
        joined("sd", 1),
        False,
        joined("position_sd_mm", 0),
    )


def judged(case: Case) -> tuple[tuple[bool, bool, bool], str]:
    """Return whether a fault was found, at the culprit alone, and as what it is; and what was said."""
    result = points2dof(case.data)
    wrong: dict[tuple[int, int], set[str]] = {}
    texts = set()
    places = [(n, c) for n, body in enumerate(case.data.bodies) for c in range(len(body.points))]
    for k, verdict in enumerate(result.channels):
        if verdict.verdict != "ok":
            wrong.setdefault(places[k % len(places)], set()).add(verdict.verdict)
            texts.add(f"{verdict.body} {verdict.point} {verdict.verdict}: {verdict.estimate}")
    named = frozenset(wrong) == case.culprits
    right = named and set().union(*wrong.values()) == {case.verdict}
    return (bool(wrong), named, right), "; ".join(sorted(texts))


def bound(clean: Measurement, case: Case) -> float:
    """Return the power of the most powerful test of this very fault, at 1 %.

    The motion is not known to it, and position errors of the stated sd are noise of known covariance.
    """
    from scipy.stats import norm

    energy = 0.0
    for body, spoiled in zip(clean.bodies, case.data.bodies, strict=True):
        if len(body.points) != len(spoiled.points):
            return float("nan")
        for run in range(len(clean.runs)):
            energy += _energy(body, spoiled, run)
    return float(norm.sf(norm.isf(ALARM) - np.sqrt(max(energy, 0.0))))


def _energy(body: BodyChannels, spoiled: BodyChannels, run: int) -> float:
    scale = 1.0 / (np.sqrt(2.0) * np.asarray(body.sd)[run].mean(axis=1, keepdims=True))
    rows = _rows(body)
    q = np.linalg.lstsq(rows * scale, body.displacement[run] * scale, rcond=None)[0]
    there = np.nan_to_num(spoiled.displacement[run])
    before = np.where(np.isnan(spoiled.displacement[run]), 0.0, body.displacement[run])
    change = scale * (there - before + (rows - _rows(spoiled)) @ q)
    span = np.linalg.qr(rows * scale / np.linalg.norm(rows, axis=0))[0]
    change = change - span @ (span.T @ change)
    columns = []
    for own in channels_of(body).values():
        for axis in np.eye(3):
            moved = np.zeros_like(change)
            moved[own] = np.cross(axis, body.directions[own]) @ q[3:] * scale[own]
            columns.append((moved - span @ (span.T @ moved)).ravel() * body.position_sd_mm[own[0]] * 1e-3)
    j = np.array(columns)
    j = np.hstack([j.real, j.imag])
    flat = np.concatenate([change.ravel().real, change.ravel().imag])
    seen = j @ flat
    taken = seen @ np.linalg.solve(j @ j.T + 0.5 * np.eye(len(j)), seen)
    return 2.0 * float(flat @ flat - taken)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--body", default="", help="only this body")
    parser.add_argument("--kind", default="", help="only this kind of fault")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every Nth place (default 1)")
    parser.add_argument("--show", action="store_true", help="tell every case that went wrong")
    arguments = parser.parse_args()
    start = time.process_time()
    single, double = sample(), sample(second_run=True)
    print("| body | fault | cases | found | culprit named | right kind | best test where not named |")
    print("|-|-|-|-|-|-|-|")
    for number, body in enumerate(single.bodies):
        for kind in KINDS if arguments.body in ("", body.body) else ():
            if arguments.kind not in ("", kind):
                continue
            data = double if kind == "runs of a point" else single
            sums, missed = np.zeros(4, dtype=int), []
            for case in islice(cases(data, number, kind, arguments.seed), 0, None, arguments.every):
                (detected, named, right), verdict = judged(case)
                sums += np.array([1, detected, named, right])
                if not named:
                    missed.append(bound(data, case))
                if arguments.show and not right:
                    best = bound(data, case)
                    print(f"    {case.name}: {verdict or 'nothing'} (best test {best:.2f})")
            best = f"{np.mean(missed):.2f}" if missed else "-"
            print(f"| {body.body} | {kind} | " + " | ".join(map(str, sums)) + f" | {best} |", flush=True)
    print(f"\n{time.process_time() - start:.0f} s of processor time, seed {arguments.seed}.")


if __name__ == "__main__":
    main()
