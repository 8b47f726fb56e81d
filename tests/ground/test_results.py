"""Results as a user meets them: a console of 80 columns, a notebook without pyplot, a table."""

import ctypes
import subprocess
import sys
import textwrap
from dataclasses import dataclass
from importlib.metadata import PathDistribution

import matplotlib
import pandas as pd

from stapeskit.arrays import return_memory
from stapeskit.provenance import versions
from stapeskit.report.figures import panels, style
from stapeskit.results import Result
from stapeskit.warnings import Notice


@dataclass(frozen=True, repr=False)
class Weighed(Result):
    rows: tuple = (("mass", "3.2 ± 0.1 mg"),)
    notices: tuple = ()

    @property
    def title(self):
        return "Mass of <one> stapes"

    def summary(self):
        return self.rows

    def to_frame(self):
        return pd.DataFrame(self.rows)

    @style()
    def plot(self):
        figure, axes = panels()
        axes[0, 0].plot([0.0, 1.0])
        return figure

    def write(self, folder, *, force=False):
        return ()


def test_a_result_fits_one_screen():
    rows = tuple((f"name {k} " + "n" * 50, "value " * 60) for k in range(200))
    lines = repr(Weighed(rows, tuple(Notice(f"code_{k}", "text") for k in range(300)))).splitlines()
    assert len(lines) <= 30
    assert all(len(line) <= 120 for line in lines[:-1])


def test_a_result_lists_its_warnings_once_each():
    found = Weighed(notices=(Notice("a_code", "one"), Notice("a_code", "two"), Notice("other", "three")))
    assert found.warnings == found.notices
    assert "a_code (2), other" in repr(found)


def test_a_notebook_gets_escaped_html():
    html = Weighed((("<b>", "<script>alert(1)</script>"),))._repr_html_()
    assert "<script>" not in html
    assert "&lt;one&gt;" in html


def test_a_figure_shows_itself_where_pyplot_was_never_imported():
    # What IPython's display formatter asks an object for: the methods by which it shows itself.
    program = textwrap.dedent(
        """
        import sys
        from stapeskit.report.figures import panels, style
        with style():
            figure, axes = panels(1, 2)
            axes[0, 0].plot([1.0, 2.0])
        assert "matplotlib.pyplot" not in sys.modules
        methods = {"image/png": "_repr_png_", "image/svg+xml": "_repr_svg_", "text/html": "_repr_html_"}
        asked = {kind: getattr(figure, name, None) for kind, name in methods.items()}
        bundle = {kind: method() for kind, method in asked.items() if method is not None}
        assert "matplotlib.pyplot" not in sys.modules
        assert bundle["image/png"].startswith(b"\\x89PNG"), bundle
        """
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_plot_returns_a_figure_of_matplotlib_and_leaves_its_settings_alone():
    before = dict(matplotlib.rcParams)
    figure = Weighed().plot()
    assert isinstance(figure, matplotlib.figure.Figure)
    assert dict(matplotlib.rcParams) == before
    assert not matplotlib.rcParams["axes.grid"]
    assert figure.axes[0].xaxis.get_gridlines()[0].get_visible()


def test_packages_of_older_installers_have_their_versions_in_the_provenance(monkeypatch):
    known, read = versions(), PathDistribution.read_text
    names = {"METADATA": "none", "PKG-INFO": "METADATA"}  # they wrote the other file
    monkeypatch.setattr(PathDistribution, "read_text", lambda one, name: read(one, names.get(name, name)))
    assert versions() == known


def test_memory_is_kept_where_the_c_library_is_not_to_be_had(monkeypatch):
    def as_on_windows(name):
        raise TypeError(name)

    monkeypatch.setattr(ctypes, "CDLL", as_on_windows)
    return_memory()
