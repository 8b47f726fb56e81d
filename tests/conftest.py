"""What tests of several rooms share."""

import pytest
from markupsafe import Markup


@pytest.fixture
def undrawn(monkeypatch):
    """Leave the drawing away: it takes most of a command's time, and tests of the pages do it."""

    def captioned(_drawing, caption, *_, **__):
        return Markup("<figure><figcaption>{}</figcaption></figure>").format(caption)

    monkeypatch.setattr("stapeskit.page.page.figure", captioned)
    monkeypatch.setattr("ct_inertia.report.pictures.render_scenes", lambda scenes: [b"png" for _ in scenes])
