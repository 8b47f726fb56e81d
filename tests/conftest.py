"""What tests of several rooms share."""

from pathlib import Path

import pytest
from markupsafe import Markup

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items):
    """Begin with the tests of the whole chain: begun last, the longest would keep one processor waiting."""
    items.sort(key=lambda item: item.path.parent != HERE)


def leave_drawing(patch):
    """Leave the drawing away: it takes most of a command's time, and tests of the pages do it."""

    def captioned(_drawing, caption, *_, **__):
        return Markup("<figure><figcaption>{}</figcaption></figure>").format(caption)

    patch.setattr("stapeskit.page.page.figure", captioned)
    patch.setattr("ct_inertia.report.pictures.render_scenes", lambda scenes: [b"png" for _ in scenes])


@pytest.fixture
def undrawn(monkeypatch):
    """Run a test without drawings."""
    leave_drawing(monkeypatch)
