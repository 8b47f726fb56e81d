"""What tests of several rooms share."""

import gc
import inspect
import pkgutil
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
from markupsafe import Markup

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items):
    """Begin with the tests of the whole chain: begun last, the longest would keep one processor waiting."""
    items.sort(key=lambda item: item.path.parent != HERE)


def pytest_collection_finish():
    """Leave modules and tests out of the search for garbage, which would look at all of them each time."""
    gc.collect()
    gc.freeze()


@cache
def drawings():
    """Every function that draws for a report, in each module that knows it."""
    rooms = [import_module(f"{room}.report") for room in ("ct_inertia", "kinematics", "fitting")]
    names = [
        module.name for room in rooms for module in pkgutil.iter_modules(room.__path__, f"{room.__name__}.")
    ]
    names += ["fitting.plan.plan_page", "pipeline.cohort.cohort_page", "pipeline.cohort.law_page"]
    return [
        (module, name)
        for module in map(import_module, names)
        for name, value in vars(module).items()
        if inspect.isfunction(value)
        and value.__annotations__.get("return") == "Figure"
        and name != "new_figure"
    ]


def leave_drawing(patch):
    """Leave the drawing away: it takes most of a command's time, and tests of the pages do it."""

    def captioned(_drawing, caption, *_, **__):
        return Markup("<figure><figcaption>{}</figcaption></figure>").format(caption)

    patch.setattr("stapeskit.page.page.figure", captioned)
    for module, name in drawings():
        patch.setattr(module, name, lambda *_, **__: None)
    patch.setattr("ct_inertia.report.pictures.render_scenes", lambda scenes: [b"png" for _ in scenes])


@pytest.fixture
def undrawn(monkeypatch):
    """Run a test without drawings."""
    leave_drawing(monkeypatch)
