"""The line that shows long work: on a terminal only, in order, and gone at the end."""

from __future__ import annotations

import io

import pytest

from legacy.ct_inertia.cli import work
from legacy.ct_inertia.ct2mass import ct2mass
from legacy.ct_inertia.options import MassOptions
from legacy.stapeskit.progress import stage_on_terminal
from tests.ct_inertia.ears import ear
from tests.ct_inertia.shapes import stapes


class Terminal(io.StringIO):
    def isatty(self):
        return True


def terminal(monkeypatch):
    made = Terminal()
    monkeypatch.setattr("sys.stderr", made)
    return made


def test_stages_are_told_in_order(tmp_path):
    import SimpleITK as sitk

    volume = ear(h=0.05, seed=3).volume
    image = sitk.GetImageFromArray(volume.array)
    image.SetSpacing(volume.spacing_mm.tolist())
    sitk.WriteImage(image, str(tmp_path / "s.nrrd"))
    told = []
    ct2mass(MassOptions(tmp_path / "s.nrrd", density=(1900.0, None)), told.append)
    assert told == [
        "reading and finding the stapes",
        "cutting the stapes out",
        "measuring the stapes",
        "finding the frames",
    ]


@pytest.mark.parametrize(("words", "shown"), [("", True), ("--quiet", False), ("--json", False)])
def test_the_command_shows_them_on_a_terminal(monkeypatch, tmp_path, words, shown):
    from legacy.ct_inertia.surface.surface import write_surface

    write_surface(tmp_path / "s.ply", stapes(0.08))
    made = terminal(monkeypatch)
    work([str(tmp_path / "s.ply"), *f"--density 1900 --no-report --out {tmp_path / 'o'} {words}".split()])
    assert ("finding the stapes" in made.getvalue()) is shown
    assert not shown or made.getvalue().endswith("\r\x1b[2K")


def interrupted():
    with stage_on_terminal(True) as tell:
        tell("reading")
        raise KeyboardInterrupt


def test_the_line_is_wiped_when_the_work_fails(monkeypatch):
    made = terminal(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert "reading" in made.getvalue()
    assert made.getvalue().endswith("\r\x1b[2K")


def test_a_file_gets_no_line(monkeypatch):
    made = io.StringIO()
    monkeypatch.setattr("sys.stderr", made)
    with stage_on_terminal(True) as tell:
        tell("reading")
    assert made.getvalue() == ""
