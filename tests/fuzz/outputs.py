"""Damaged folders of outputs, which may come from anybody: the program's own records, and pages."""

from __future__ import annotations

import base64
import gzip
import io
import json
import random
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.fuzz.case import Case
from tests.fuzz.mutations import NUMBERS, TEXTS, json_bytes, mutate_bytes, mutate_numbers, mutate_tree

_FAST = 0.97  # share of cases without a drawing, which takes a hundred times as long
_STAGE = "scan"


def cases(rng: random.Random) -> Iterator[Case]:
    """Yield damaged folders without end."""
    while True:
        yield rng.choice((_record, _sections, _truth, _labels))(rng) if rng.random() < _FAST else _page(rng)


def prepare() -> None:
    """Make the sound folder before the process is forked."""
    sound()
    drawings()


@cache
def sound() -> dict[str, bytes]:
    """Make the records of a finished stage and of a command."""
    from legacy.pipeline.stage_records import StageRecord, StageReport, write_record, write_stage_report
    from legacy.stapeskit.own_files import OutputSet
    from legacy.stapeskit.page import page
    from legacy.stapeskit.warnings import Notice

    with TemporaryDirectory() as name:
        folder = Path(name)
        outputs = OutputSet("dof2kd", folder, ("plan.json", "plan.html"))
        with outputs.staged() as stage:
            (stage / "plan.json").write_text("{}")
            (stage / "plan.html").write_text("page")
        section = page.Section("Motion", [page.text("words"), page.table(("a", "b"), [("1", "2")])], "motion")
        write_stage_report(folder, _STAGE, StageReport((section,), (Notice("a", "b"),)))
        write_record(folder, StageRecord(_STAGE, {"code": "1"}, {"mass.json": "xxh3_128:0"}, 1.5))
        return {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }


@cache
def drawings() -> dict[str, bytes]:
    """Draw a small figure of both kinds."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.0, 1.0))
    figure.add_subplot().plot([1.0, 2.0, 1.5], "--")
    made = {}
    for kind in ("svg", "png"):
        stream = io.BytesIO()
        figure.savefig(stream, format=kind, dpi=30)
        made[kind] = stream.getvalue()
    return made


def _changed(rng: random.Random, name: str) -> dict[str, bytes]:
    text = sound()[name]
    whole = json_bytes(rng, mutate_tree(rng, json.loads(text)))
    odd = rng.choice((b"[" * 100_000, b'{"schema":' * 20_000, b"", mutate_bytes(rng, text)))
    return {**sound(), name: whole if rng.random() < 0.8 else odd}


def _record(rng: random.Random) -> Case:
    name = rng.choice([name for name in sound() if name.endswith(".json") and ".stapeskit/" in name])
    return Case(f"record {name}", _changed(rng, name), ("read_own", _STAGE))


def _sections(rng: random.Random) -> Case:
    name = f".stapeskit/{_STAGE}.sections.json"
    return Case("sections", _changed(rng, name), ("read_own", _STAGE))


def _truth(rng: random.Random) -> Case:
    truth = {"mass_kg": 3e-6, "dof": ["y"], "stiffness_si": [[1.0]], "damping_si": [[2.0]]}
    content = json_bytes(rng, mutate_tree(rng, truth))
    return Case("truth", {"truth.json": content}, ("read_truth", "truth.json"))


def _labels(rng: random.Random) -> Case:
    """Damage the labels beside mass.json."""
    fields = [
        "NRRD0004\ntype: uint8\ndimension: 3\nspace: left-posterior-superior\nsizes: 5 6 7\nencoding: gzip",
        "space directions: (0.02,0,0) (0,0.02,0) (0,0,0.02)\nspace origin: (0,0,0)",
    ]
    lines = "\n".join(fields).encode().split(b"\n")
    for _ in range(rng.randint(0, 2)):
        row = rng.randrange(len(lines))
        key = lines[row].partition(b":")[0]
        odd = rng.choice((*NUMBERS, *TEXTS)).encode("utf-8", "surrogatepass")
        lines[row] = rng.choice((mutate_numbers(rng, lines[row]), key + b": " + odd, b""))
    head = b"\n".join(lines) + b"\n\n"
    whole = head + gzip.compress(bytes(210))
    damaged = mutate_bytes(rng, whole, head=len(head)) if rng.random() < 0.5 else whole
    return Case("labels beside mass.json", {"labels.nrrd": damaged}, ("read_beside_mass", "labels.nrrd"))


def _page(rng: random.Random) -> Case:
    """Damage the drawings of a page, or the page itself."""
    kind = rng.choice(sorted(drawings()))
    drawing = rng.choice((mutate_bytes, mutate_numbers))(rng, drawings()[kind])
    packed = base64.b64encode(drawing).decode()
    mime = {"svg": "svg+xml", "png": "png"}[kind]
    heading = rng.choice((*TEXTS[:4], "Motion", "a" * 3000)).replace("\x00", "")
    page = f'<h2>{heading}</h2><img src="data:image/{mime};base64,{packed}">'
    page += "<table>" + "<tr><td>1<td>=1+cmd|x" * 3 + "</table>"
    content = page.encode("utf-8", "replace")
    content = mutate_bytes(rng, content) if rng.random() < 0.3 else content
    return Case(f"page with {kind}", {"page.html": content}, ("stapeskit", "figures", "page.html", "out"))
