"""The report: every section, nothing from the network, the notes at the top."""

import re
from html.parser import HTMLParser
from itertools import pairwise

import pytest

from legacy.pipeline.errors import PipelineError
from legacy.pipeline.report import ordered, read_truth
from legacy.pipeline.stage_records import StageReport
from legacy.stapeskit.page.page import Section

HEADINGS = (
    "This ear",
    "The stapes in three dimensions",
    "Accept or correct the cut",
    "Warnings",
    "Methods in words",
    "Scan and mass",
    "The stapes in its frames",
    "Mass matrix M",
    "Uncertainty of M",
    "Motion",
    "Points and beams",
    "Motion of stapes and bone",
    "Verdict on every channel",
    "Ligament",
    "Measured and simulated responses",
    "Stiffness K and damping D",
    "Modes",
    "Principal axes on the footplate",
    "Uncertainty of K and D",
    "Record",
    "Inputs",
)


class Reader(HTMLParser):
    """Collects headings, references and pictures."""

    def __init__(self):
        super().__init__()
        self.headings, self.references, self.pictures, self.inside = [], [], 0, ""

    def handle_starttag(self, tag, attrs):
        self.inside = tag
        for name, value in attrs:
            if name in ("src", "href", "data", "action", "poster", "srcset"):
                self.references.append(value)
        self.pictures += tag == "img"

    def handle_data(self, data):
        if self.inside == "h2" and data.strip():
            self.headings.append(data)

    def handle_endtag(self, tag):
        self.inside = ""


@pytest.fixture(scope="module")
def page(finished):
    text = (finished[1] / "report.html").read_text(encoding="utf-8")
    reader = Reader()
    reader.feed(text)
    return text, reader


def test_sections_stand_in_their_order(page):
    found = [heading for heading in page[1].headings if heading in HEADINGS]
    assert tuple(found) == HEADINGS
    assert len(set(page[1].headings)) == len(page[1].headings)


def test_a_screen_reader_finds_its_way(page):
    """Headings without jumps, a name for every picture, table and control, and captions where they belong."""
    text, _ = page
    levels = [int(level) for level in re.findall(r"<h([1-6])[ >]", text)]
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    assert all(re.search(r'alt="[^"]+"', image) for image in re.findall(r"<img [^>]*>", text))
    assert all("aria-label=" in canvas for canvas in re.findall(r"<canvas[^>]*>", text))
    for table in re.findall(r"<table.*?</table>", text, re.DOTALL):
        heads = re.findall(r"<th[ >][^>]*", table)
        assert heads
        assert all("scope=" in head for head in heads)
    for caption in re.finditer("<figcaption>", text):
        before = text[: caption.start()]
        assert before.rfind("<figure") > before.rfind("</figure>")


def test_nothing_comes_from_the_network(page):
    text, reader = page
    assert reader.pictures >= 7
    assert all(value.startswith(("data:image/", "#")) for value in reader.references)
    outside = re.sub(r'src="data:[^"]*"', "", text)
    assert not re.search(r"url\(|<script[^>]* src|<link|@import|https?://", outside)


def test_notes_key_results_warnings_and_hashes(page, finished):
    text, _ = page
    top = text.partition('<section id="stapes_3d"')[0]
    warned = text.partition("<h2>Warnings</h2>")[2].partition("</section>")[0]
    assert "SIMULATED vibrometer data." in top
    assert "Incus removed." in top
    for words in (
        "mass",
        "K(y)",
        "D(gamma)",
        "mode 3",
        "µN mm s/rad",
        "damping ratio",
        "superior: stated as a left ear",
    ):
        assert words in top
    for notice in finished[2].notices:
        assert notice.code in warned
    for name in ("study.toml", "ldv.csv", "points.csv", "fiducials.csv", "stapes.ply"):
        assert re.search(rf"{name}</td>.*?xxh3_128:[0-9a-f]{{32}}", text, re.DOTALL)


def test_every_warning_is_in_words_of_the_study_file(finished):
    for notice in finished[2].notices:
        assert "--" not in notice.text


def test_texts_name_the_keys_of_the_study_file(page):
    for option in ("--seed", "--threshold", "--labels", "--robust", "--bands"):
        assert option not in page[0]


def test_sections_of_all_stages_are_ordered_by_key():
    told = {
        "scan": StageReport(
            (Section("A", key="mass_uncertainty"), Section("B"), Section("C", key="segmentation"))
        ),
        "fit": StageReport((Section("D", key="modes"), Section("E", key="stiffness_and_damping"))),
        "other": StageReport((Section("F", key="of_no_page"),)),
    }
    assert [(section.group, section.heading) for section in ordered(told)] == [
        ("Scan and mass", "Segmentation"),
        ("Scan and mass", "Uncertainty of M"),
        ("Scan and mass", "B"),
        ("Ligament", "Stiffness K and damping D"),
        ("Ligament", "Modes"),
        ("Record", "F"),
    ]


@pytest.mark.parametrize(
    "text",
    [
        *(
            "[]",
            "[" * 100_000,
            '{"mass_kg": "heavy"}',
            '{"mass_kg": NaN}',
            '{"dof": 3}',
            '{"stiffness_si": 3}',
        ),
        *('{"dof": ["y"], "stiffness_si": [[1, 2]]}', '{"dof": ["y"], "damping_si": [["1"]]}'),
    ],
)
def test_true_values_that_are_none_are_refused(text, tmp_path):
    (tmp_path / "truth.json").write_text(text, encoding="utf-8")
    with pytest.raises(PipelineError, match=r"study\.truth must be"):
        read_truth(tmp_path / "truth.json")
