"""``dof.html``: every section with its values, nothing from elsewhere, small, and readable without eyes."""

from __future__ import annotations

import base64
import json
import re
import time
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from legacy.kinematics.fit_options import Options
from legacy.kinematics.measurement import BodyChannels, Measurement
from legacy.kinematics.points2dof import points2dof
from legacy.kinematics.report.fault_sections import groups_of, residual_section, verdict_section
from legacy.kinematics.report.motion_sections import motion_section, moving_section
from legacy.kinematics.report.sections import grouped_notices, write_report
from legacy.kinematics.report.stapes_surface import Scenery
from legacy.stapeskit.warnings import Notice
from tests.kinematics.simulated import (
    body,
    measurement,
    readings,
    scene,
    smooth_motion,
    stapes_points,
    three_beams,
)
from tests.stapeskit.page.test_drawings import sphere

HEADINGS = (
    "Warnings",
    "Points and beams",
    "Motion at one frequency",
    "Motion of the rigid bodies",
    "Verdict on every channel",
    "Residuals of the rigid fit",
    "How the lasers agree",
    "Inputs",
)
EVIL = "</script><b>\"&' $x$ {{ 7 * 7 }}"


class Reader(HTMLParser):
    """Collects what a reader, a screen reader and a browser would."""

    def __init__(self, text):
        super().__init__()
        self.headings, self.references, self.unnamed, self.tags, self.open = [], [], [], {}, []
        self.labels, self.fields = set(), set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.tags[tag] = self.tags.get(tag, 0) + 1
        if tag not in ("img", "meta", "input", "br", "link"):
            self.open.append(tag)
        self.references += [v for k, v in attrs if k in ("src", "href", "data", "action", "srcset", "poster")]
        if tag == "img" and not found.get("alt"):
            self.unnamed.append(found)
        if tag == "canvas" and not (found.get("aria-label") and found.get("role") == "img"):
            self.unnamed.append(found)
        if tag == "input":
            self.fields.add(found.get("id"))
        if tag == "label" and found.get("for"):
            self.labels.add(found["for"])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "h2" and data.strip():
            self.headings.append(data)


@pytest.fixture(scope="module")
def scenery():
    vertices, faces = sphere(1.6, rings=12, centre=(0.0, 1.5, 0.0))
    ring = np.linspace(0.0, 2.0 * np.pi, 30)
    outline = np.column_stack([1.4 * np.cos(ring), np.zeros(30), 0.6 * np.sin(ring)])
    return Scenery(vertices, faces, outline, "superior")


@pytest.fixture(scope="module")
def result():
    one, two = scene(3, "gain", lines=120), scene(4, "position", lines=120)
    made = points2dof(measurement(body("stapes", one), body("base", two), freq_hz=one.freq_hz))
    assert {v.verdict for v in made.channels} == {"ok", "gain", "position"}
    return made


@pytest.fixture(scope="module")
def page(result, scenery, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "dof.html"
    write_report(path, result, scenery)
    text = path.read_text(encoding="utf-8")
    return text, Reader(text)


def picture(text):
    found = re.search(r'<script type="application/json" id="motion-data">(.*?)</script>', text, re.DOTALL)
    return json.loads(found.group(1))


def words(text):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", text))


def test_every_section_stands_in_its_order(page):
    assert tuple(page[1].headings) == HEADINGS
    assert page[1].open == []


def test_nothing_comes_from_elsewhere(page):
    text, reader = page
    assert all(value.startswith(("data:image/", "#")) for value in reader.references)
    bare = re.sub(r'src="data:[^"]*"', "", text)
    assert not re.search(r"https?:|//[a-z]+\.|url\(|@import|<link|<iframe|fetch\(|XMLHttp|import\(", bare)
    assert "src=" not in "".join(re.findall(r"<script[^>]*>", text))


def test_what_is_drawn_has_words_and_what_is_moved_has_names(page):
    _, reader = page
    assert reader.unnamed == []
    assert reader.tags["img"] >= 5
    assert reader.tags["canvas"] == 4
    assert reader.fields == {"motion-line", "motion-phase", "motion-size"}
    assert reader.fields <= reader.labels
    assert reader.tags["th"] > 0
    assert 'lang="en"' in page[0]


def test_the_page_prints_and_respects_who_wants_no_motion(page):
    text = page[0]
    assert "@page { size: A4" in text
    assert ".motion { display: none; }" in text
    assert "prefers-reduced-motion" in text
    assert "requestAnimationFrame" in text


def test_the_faults_stand_at_the_top_and_in_the_table_with_what_to_do(page, result):
    top = words(page[0].split("<section")[1])
    assert "4 of 54 channels have a verdict" in top
    assert "channel_gain" in top
    assert "channel_position" in top
    table = words("".join(verdict_section(result).blocks))
    for group in groups_of(result):
        assert group.names[0] in table
        assert group.verdict.estimate.replace(" +- ", " ± ") in table
    assert "divide its values by the factor" in table
    assert "Check the coordinates of the point." in table


def test_faults_are_sorted_by_what_they_add_to_the_residual(result):
    groups = groups_of(result)
    fits = {body.body: fit for body, fit in zip(result.measurement.bodies, result.fits.values(), strict=True)}
    assert [g.excess for g in groups] == sorted((g.excess for g in groups), reverse=True)
    gain = next(g for g in groups if g.verdict.verdict == "gain")
    channel = next(k for k, v in enumerate(result.channels) if v.verdict == "gain")
    assert gain.rms**2 == pytest.approx(fits["stapes"].channel_energy[channel])
    position = next(g for g in groups if g.verdict.verdict == "position")
    assert len(position.names) == 1
    assert position.names[0].endswith("all 3 beams")


def test_the_picture_holds_the_motion_itself(page, result):
    data = picture(page[0])
    assert data["freq"] == pytest.approx(result.motion.freq_hz, rel=1e-8)
    numbers = np.frombuffer(base64.b64decode(data["q"][0][1]), dtype="<f4").reshape(-1, 12)
    expected = result.motion.q[0, 1]
    assert numbers[:, :6] + 1j * numbers[:, 6:] == pytest.approx(expected, rel=1e-6, abs=1e-20)
    assert data["own"] == 0
    assert [b["name"] for b in data["bodies"]] == ["stapes", "base"]
    assert len(data["bodies"][0]["points"]) == 9
    assert data["unit"] == "m"


def test_the_picture_holds_the_surface(page, scenery):
    mesh = picture(page[0])["mesh"]
    vertices = np.frombuffer(base64.b64decode(mesh["vertices"]), dtype="<i2").reshape(-1, 3)
    faces = np.frombuffer(base64.b64decode(mesh["faces"]), dtype="<u2").reshape(-1, 3)
    placed = np.array(mesh["low"]) + vertices * mesh["step"]
    distance = np.linalg.norm(placed - [0.0, 1.5, 0.0], axis=1)
    assert np.all(np.abs(distance - 1.6) < 2e-4)
    assert faces.max() < len(vertices)
    assert len(faces) == len(scenery.faces)


def test_the_static_picture_says_how_much_is_exaggerated(page):
    caption = re.search(
        r"8 phases of one period, ([\d,]+) times larger than life; .*? ([\d.]+) nm", words(page[0])
    )
    factor, size = float(caption.group(1).replace(",", "")), float(caption.group(2))
    assert 0.1e-3 < factor * size * 1e-9 < 0.8e-3


def test_names_cannot_break_out_of_the_page(result, tmp_path):
    bodies = tuple(
        replace(b, body=f"{b.body} {EVIL}", points=tuple(f"{p} {EVIL}" for p in b.points))
        for b in result.measurement.bodies
    )
    made = points2dof(replace(result.measurement, bodies=bodies, runs=(f"1 {EVIL}",)))
    write_report(tmp_path / "dof.html", made)
    text = (tmp_path / "dof.html").read_text(encoding="utf-8")
    reader = Reader(text)
    assert reader.tags["script"] == 3
    assert "b" not in reader.tags
    assert picture(text)["bodies"][0]["name"].startswith("stapes </")
    assert "49" not in picture(text)["bodies"][0]["name"]


@pytest.mark.parametrize("options", [Options(("y", "alpha", "gamma")), Options(reference="base:y")])
def test_subsets_and_references_are_named_with_their_units(options):
    one, two = scene(3, lines=40), scene(4, lines=40)
    made = points2dof(measurement(body("stapes", one), body("base", two), freq_hz=one.freq_hz), None, options)
    text = "".join(moving_section(made, Scenery(), interactive=True).blocks)
    if options.reference:
        assert picture(text)["unit"] == "m/m"
        assert "m per m of base:y" in words(text)
        drawn = float(re.search(r"drawn as for base:y = ([\d.]+) mm", words(text)).group(1))
        assert 0.001 < drawn < 1.0
        assert "per unit of base:y" in words("".join(motion_section(made).blocks))
    else:
        numbers = np.frombuffer(base64.b64decode(picture(text)["q"][0][0]), dtype="<f4").reshape(-1, 12)
        assert np.all(numbers[:, [0, 2, 4, 6, 8, 10]] == 0.0)
        assert np.all(numbers[:, [1, 7]] != 0.0)


def test_one_line_and_one_beam_a_point_make_a_page(tmp_path):
    one = scene(5, lines=1)
    channels = body("incus", one)
    upright = replace(
        channels,
        points=channels.points[::3],
        positions_mm=channels.positions_mm[::3],
        directions=np.tile([0.0, 1.0, 0.0], (9, 1)),
        reported_directions=np.tile([0.0, 1.0, 0.0], (9, 1)),
        displacement=channels.displacement[:, ::3],
        sd=channels.sd[:, ::3],
        position_sd_mm=channels.position_sd_mm[::3],
    )
    made = points2dof(measurement(upright, freq_hz=one.freq_hz), None, Options(("y", "alpha", "gamma")))
    write_report(tmp_path / "dof.html", made)
    text = words((tmp_path / "dof.html").read_text(encoding="utf-8"))
    assert "rotation about the y axis" in text
    assert "No surface of the stapes was given." in text
    assert re.search(r"1 run, 1 line at \S+ Hz;", text)


def test_many_runs_are_drawn_where_something_is_wrong():
    made = scene(6, "gain", lines=30)
    clean = scene(6, lines=30)
    value = np.stack([clean.value] * 4 + [made.value] + [clean.value])
    channels = replace(body("stapes", made), displacement=value, sd=np.repeat(made.sd[None], 6, axis=0))
    runs = tuple(f"shaker {k}" for k in range(6))
    found = points2dof(Measurement("footplate", runs, made.freq_hz, (channels,), 0))
    assert "27 channels in each of 6 runs" in words("".join(verdict_section(found).blocks))
    text = words("".join(residual_section(found).blocks))
    assert "in units of its sd, run shaker 4" in text
    assert "in units of its sd, run shaker 0" not in text
    assert "1 of 6 runs drawn" in text


def test_of_many_warnings_of_one_code_most_are_folded():
    many = [Notice("zero_rows", f"channel {k}") for k in range(30)] + [Notice("other", "alone")]
    blocks = "".join(grouped_notices(many))
    assert blocks.count("channel ") == 30
    assert "26 more with the code zero_rows" in blocks
    assert blocks.index("channel 3<") < blocks.index("<details>") < blocks.index("channel 4<")
    assert "alone" in blocks


def test_the_pipeline_gets_the_motion_without_a_script(result, scenery):
    text = "".join(moving_section(result, scenery, interactive=False).blocks)
    assert "<script" not in text
    assert "<canvas" not in text
    assert "phases of one period" in text


def test_a_large_measurement_makes_a_small_page_soon(tmp_path):
    rng = np.random.default_rng(5)
    freq = np.linspace(100.0, 10000.0, 2500)

    def large(name):
        places = np.repeat(stapes_points(rng, 100), 3, axis=0)
        beams = np.tile(three_beams(), (100, 1))
        value = readings(places, beams, smooth_motion(rng, freq))
        sd = np.full(value.shape, np.sqrt(np.mean(np.abs(value) ** 2)) / 100.0)
        value = value + sd * (rng.normal(size=(*value.shape, 2)) @ np.array([1.0, 1j]))
        value[7] *= 1.1
        points = tuple(f"P{1 + c // 3}" for c in range(300))
        return BodyChannels(name, points, places, beams, value[None], sd[None])

    made = points2dof(Measurement("footplate", ("1",), freq, (large("stapes"), large("base")), 0))
    start = time.process_time()
    write_report(tmp_path / "dof.html", made)
    assert time.process_time() - start < 15.0
    assert (tmp_path / "dof.html").stat().st_size < 3_000_000
    text = (tmp_path / "dof.html").read_text(encoding="utf-8")
    assert len(picture(text)["freq"]) == 2500
    assert "2 of 600 channels have a verdict" in words(text)


def test_a_stapes_far_from_the_footplate_is_told_of():
    one = scene(3, lines=20)
    near, far = body("stapes", one), body("stapes", one)
    far = replace(far, positions_mm=far.positions_mm + np.array([12.0, -9.0, -3.0]))
    codes = [
        [notice.code for notice in points2dof(measurement(each, freq_hz=one.freq_hz)).notices]
        for each in (near, far)
    ]
    assert "far_from_footplate" not in codes[0]
    assert "far_from_footplate" in codes[1]
