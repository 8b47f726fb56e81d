"""What tests of several rooms share."""

import gc
import inspect
import pkgutil
from dataclasses import fields
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
from markupsafe import Markup

HERE = Path(__file__).parent
# Options that enter neither the reading of a scan nor the search for its bodies.
_AFTERWARDS = (
    *("density", "mass_mg", "calibration", "add_mass", "voxel_size_sd_percent", "scale_length", "scale_ball"),
    *("anterior", "side", "landmarks", "plate_fiducials"),
)


def pytest_collection_modifyitems(items):
    """Begin with the tests of the whole chain: begun last, the longest would keep one processor waiting."""
    items.sort(key=lambda item: item.path.parent != HERE)


def pytest_collection_finish():
    """Leave modules and tests out of the search for garbage, which would look at all of them each time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000)


@cache
def drawings():
    """Every function that draws for a report, in each module that knows it."""
    rooms = [import_module(f"legacy.{room}.report") for room in ("ct_inertia", "kinematics", "fitting")]
    names = [
        module.name for room in rooms for module in pkgutil.iter_modules(room.__path__, f"{room.__name__}.")
    ]
    names += [
        "legacy.fitting.plan.plan_page",
        "legacy.pipeline.cohort.cohort_page",
        "legacy.pipeline.cohort.law_page",
    ]
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

    patch.setattr("legacy.stapeskit.page.page.figure", captioned)
    for module, name in drawings():
        patch.setattr(module, name, lambda *_, **__: None)
    patch.setattr("legacy.ct_inertia.report.pictures.render_scenes", lambda scenes: [b"png" for _ in scenes])


@pytest.fixture
def undrawn(monkeypatch):
    """Run a test without drawings."""
    leave_drawing(monkeypatch)


@pytest.fixture(scope="module")
def found_once():
    """Find the bodies of a scan and the frame of a surface once, for tests of what comes after them."""
    from legacy.ct_inertia import ct2mass, frames_and_mass
    from legacy.stapeskit.input_changes import InputStates

    find_bodies, find_frame = ct2mass._bodies, frames_and_mass.footplate_frame
    known = {}

    def bodies(options, progress):
        given = {field.name: getattr(options, field.name) for field in fields(options)}
        sought = {name: value for name, value in given.items() if name not in _AFTERWARDS}
        key = repr(sought), repr(InputStates.of([options.scan, options.labels]))
        if key not in known:
            known[key] = find_bodies(options, progress)
        return known[key]

    def frame(surface, hints=None, *blur, **more):
        key = surface.vertices_mm.tobytes(), surface.faces.tobytes(), repr((hints, blur, more))
        if key not in known:
            known[key] = find_frame(surface, hints, *blur, **more)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ct2mass, "_bodies", bodies)
        patch.setattr(frames_and_mass, "footplate_frame", frame)
        yield
