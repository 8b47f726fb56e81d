"""The layout of the page of `stapeskit app`, by marimo; session.py does what it offers.

A widget lives as long as the cell that made it: controls that set a state do not depend on it, surfaces have
one cell a group, and none of them depends on the clock.
"""

import marimo

app = marimo.App(width="full", app_title="stapeskit", css_file="page.css")

with app.setup:
    import sys
    import traceback
    import webbrowser
    from pathlib import Path
    from typing import get_args

    import marimo as mo

    from app import tables
    from app.drawing import PENS
    from app.grey import beneath, first_look
    from app.picture import VIEWS, Picture
    from app.session import Session
    from fitting.options import KDOptions
    from pipeline.new_study import ASSUMED_DENSITY
    from stapeskit.faults import StapeskitError

    def listed(*items):
        """Lay items below each other."""
        return mo.vstack([item for item in items if item is not None])

    def beside(*items):
        """Lay items beside each other; they wrap where the page is narrow."""
        return mo.hstack(list(items), wrap=True, justify="start", align="end")


@app.cell
def state():
    session = Session(Path(mo.cli_args().get("folder") or "."))
    picture = Picture()
    get_study, set_study = mo.state(0)  # counters: what depends on one is shown anew when it goes up
    get_picture, set_picture = mo.state(0)
    get_mass, set_mass = mo.state(0)
    get_undone, set_undone = mo.state(0)
    get_marks, set_marks = mo.state(0)
    get_points, set_points = mo.state(0)
    get_fit, set_fit = mo.state(0)
    get_busy, set_busy = mo.state(False)
    get_point, set_point = mo.state(None)
    get_said, set_said = mo.state(("", "Choose a scan, or a study to go on with."))

    def up(*setters):
        for setter in setters:
            setter(lambda count: count + 1)

    shown = {"danger": False}

    def attempt(action, *setters):
        """Do what a control asks for; what is wrong is shown in the library's own words."""
        danger, text = False, None
        try:
            text = action()
        except (StapeskitError, OSError) as error:
            danger, text = True, str(error)
        except Exception:
            traceback.print_exc(file=sys.stderr)
            danger, text = (
                True,
                "stapeskit failed here. This is a bug: please report the lines in the terminal.",
            )
        else:
            up(*setters)
        if text or shown["danger"]:
            set_said(("danger" if danger else "", text or ""))
        shown["danger"] = danger

    def begin(step, before=lambda: None):
        def action():
            before()
            session.start(step)
            set_busy(True)

        attempt(action)

    picture.on_point = set_point
    picture.on_stroke = lambda: attempt(session.end_stroke)
    return (
        attempt, begin, get_busy, get_fit, get_marks, get_mass, get_picture, get_point, get_points,
        get_said, get_study, picture, session, set_busy, set_fit, set_marks, set_mass, set_picture,
        get_undone, set_points, set_said, set_study, set_undone, up,
    )  # fmt: skip


@app.cell
def choose(attempt, session, set_fit, set_marks, set_mass, set_picture, set_points, set_study):
    def chosen(files):
        def action():
            path = Path(files[0].path)
            session.open(path) if path.suffix == ".toml" else session.begin(path)
            return f"{path.name} opened."

        if files:
            attempt(action, set_study, set_picture, set_mass, set_marks, set_points, set_fit)

    browser = mo.ui.file_browser(
        initial_path=session.folder, multiple=False, restrict_navigation=False, selection_mode="all",
        label="A scan, or a study (.toml) to go on with", on_change=chosen,
    )  # fmt: skip
    return (browser,)


@app.cell
def scan_controls(attempt, begin, get_study, picture, session, set_study):
    get_study()

    def scan_value(table, key, default=""):
        value = session.study.get(table, key) if session.study else None
        return default if value is None else str(value)

    def put_scan(key, value):
        attempt(lambda: session.opened_study.put("scan", **{key: value}))

    def measure(_):
        begin("found", lambda: session.set_scan(density.value, side.value))

    def put_box(corner):
        def action():
            if picture.point is None:
                raise StapeskitError("Click a place in a slice first.")
            session.put_box_corner(corner, picture.point)

        attempt(action, set_study)

    def put_seed(_):
        def action():
            if picture.point is None:
                raise StapeskitError("Click a place inside the stapes first.")
            session.put_search(seed_mm=[round(float(value), 4) for value in picture.point])

        attempt(action, set_study)

    name = mo.ui.text(
        session.study.path.stem if session.study else "", label="name",
        on_change=lambda value: attempt(lambda: session.rename(value)),
    )  # fmt: skip
    density = mo.ui.text(scan_value("scan", "density_kg_m3", ASSUMED_DENSITY), label="density, kg/m³")
    side = mo.ui.dropdown(["left", "right"], value=scan_value("scan", "side") or None, label="side")
    spacing = mo.ui.text(
        scan_value("scan", "spacing_mm"), label="voxel, mm", placeholder="from the scan",
        on_change=lambda value: put_scan("spacing_mm", value),
    )  # fmt: skip
    seed = mo.ui.button(label="Crosshair is in the stapes", on_click=put_seed)
    low = mo.ui.button(label="is one corner", on_click=lambda _: put_box(0))
    high = mo.ui.button(label="is the other corner", on_click=lambda _: put_box(1))
    forget = mo.ui.button(label="Forget both", on_click=lambda _: attempt(session.forget_search, set_study))
    measure_button = mo.ui.button(label="Measure", kind="success", on_click=measure)
    search = mo.md(session.search_text())
    return density, forget, high, low, measure_button, name, search, seed, side, spacing


@app.cell
def cut_controls(attempt, begin, picture, session, set_undone):
    pens = {"look": None, **PENS}
    pen = mo.ui.radio(pens, value="look", inline=True, on_change=lambda value: setattr(picture, "pen", value))
    radius = mo.ui.slider(
        1, 15, value=3, label="radius, voxels", show_value=True,
        on_change=lambda value: setattr(picture, "radius", value),
    )  # fmt: skip
    ball = mo.ui.switch(
        True, label="ball (off: this slice)", on_change=lambda value: setattr(picture, "ball", value)
    )
    boundary = mo.ui.switch(
        False, label="boundary only", on_change=lambda value: picture.show_boundary(value)
    )
    view = mo.ui.radio(VIEWS, value=VIEWS[0], inline=True, on_change=lambda value: picture.set_view(value))
    undo = mo.ui.button(
        label="Undo", on_click=lambda _: attempt(lambda: picture.show_change(session.undo()), set_undone)
    )

    def back(_):
        attempt(session.reset, set_undone)
        picture.show_all()

    reset = mo.ui.button(label="Back to the cut as found", on_click=back)
    again = mo.ui.button(label="Measure again", kind="success", on_click=lambda _: begin("cut"))
    return again, ball, boundary, pen, radius, reset, undo, view


@app.cell
def mark_controls(attempt, get_points, get_study, picture, session, set_marks):
    get_study(), get_points()  # the names come from the fiducials of the study

    def put_mark(remove=False):
        def action():
            if session.marks is None:
                raise StapeskitError("Choose a scan first.")
            if picture.point is None and not remove:
                raise StapeskitError("Click a place in a slice first.")
            session.marks.put(mark.value, None if remove else picture.point)

        attempt(action, set_marks)

    names = session.marks.names if session.marks else ["anterior"]
    mark = mo.ui.dropdown(names, value=names[0], label="the crosshair is at")
    set_mark = mo.ui.button(label="Set mark", on_click=lambda _: put_mark())
    remove_mark = mo.ui.button(label="Remove it", on_click=lambda _: put_mark(remove=True))
    return mark, remove_mark, set_mark


@app.cell
def measurement_controls(attempt, begin, get_study, session):
    get_study()

    def pick(key):
        files, value = session.files(), session.study.get("ldv", key) if session.study else None
        chosen = value[0] if isinstance(value, list) else value
        return mo.ui.dropdown(
            files, value=chosen if chosen in files else None, allow_select_none=True,
            label="vibrometer file" if key == "file" else key,
            on_change=lambda name: attempt(lambda: session.set_measurement(key, name)),
        )  # fmt: skip

    ldv, points, fiducials = (pick(key) for key in ("file", "points", "fiducials"))
    look = mo.ui.button(label="Look at it", kind="success", on_click=lambda _: begin("points"))
    return fiducials, ldv, look, points


@app.cell
def leave_out_controls(attempt, get_points, get_study, session):
    get_study(), get_points()
    options, gone = session.leave_out_choice()
    leave_out = mo.ui.multiselect(
        options, value=gone, label="leave out", full_width=True,
        on_change=lambda names: attempt(lambda: session.opened_study.put("ldv", leave_out=list(names))),
    )  # fmt: skip
    return (leave_out,)


@app.cell
def fit_controls(attempt, begin, get_fit, get_study, session):
    get_study(), get_fit()

    def put_fit(table, key, value):
        attempt(lambda: session.opened_study.put(table, **{key: value}))

    def fit_value(key, default):
        value = session.study.get("fit", key) if session.study else None
        if value is None:
            return default
        parts = value if isinstance(value, list) else [value]
        return ", ".join("-".join(map(str, one)) if isinstance(one, list) else str(one) for one in parts)

    keys = {entry.key: entry for entry in KDOptions.entries()}
    dof = mo.ui.text(
        fit_value("dof", ",".join(keys["dof"].default)), label="degrees of freedom",
        on_change=lambda value: put_fit("fit", "dof", value),
    )  # fmt: skip
    exclude = mo.ui.text(
        fit_value("exclude_hz", ""), label="leave out, Hz", placeholder="900-1000, 1980-2020",
        on_change=lambda value: put_fit("fit", "exclude_hz", [one for one in value.split(",") if one]),
    )  # fmt: skip
    laws = [*get_args(keys["damping"].annotation)]
    damping = mo.ui.dropdown(
        laws,
        value=fit_value("damping", laws[0]),
        label="damping",
        on_change=lambda value: put_fit("fit", "damping", value),
    )
    codes, ticked = session.reasons()
    confirm = mo.ui.multiselect(
        codes, value=ticked, label="checked and right", full_width=True,
        on_change=lambda names: put_fit("study", "confirmed", list(names)),
    )  # fmt: skip
    fit = mo.ui.button(label="Fit", kind="success", on_click=lambda _: begin("fit"))
    open_report = mo.ui.button(
        label="Open the report",
        on_click=lambda _: attempt(lambda: webbrowser.open(session.report().as_uri()) and None),
    )
    other = mo.ui.dropdown(session.other_results(), label="beside it", allow_select_none=True)
    return confirm, damping, dof, exclude, fit, open_report, other


@app.cell
def show_picture(get_picture, picture, session, attempt):
    get_picture()

    def show():
        if session.drawing is not None and session.scan is not None:
            picture.show(beneath(session.scan, session.drawing), session.drawing.affine, session.drawing)
        elif session.drawing is not None:
            picture.show(60 * session.drawing.shown, session.drawing.affine, session.drawing)
        elif session.scan is not None:
            picture.show(*first_look(session.scan))

    if session.study is not None:
        attempt(show)
    return


@app.cell
def show_surfaces(get_mass, picture, session):
    get_mass()
    picture.show_surfaces(session.surfaces())
    return


@app.cell
def show_marks(get_marks, picture, session):
    get_marks()
    placed = session.marks.placed if session.marks else {}
    picture.show_marks(list(placed.values()))
    marks_table = mo.Html(
        tables.html_table(
            [
                {"mark": name, "scan x, y, z, mm": ", ".join(f"{v:.3f}" for v in at)}
                for name, at in placed.items()
            ]
        )
    )
    return (marks_table,)


@app.cell
def show_points(get_points, picture, session):
    get_points()
    measured = session.content("points")
    picture.show_points(measured["beams"] if measured and measured["in_scan"] else [])
    registration = mo.md(tables.registration_text(measured) if measured else "")
    return measured, registration


@app.cell
def layout_picture(picture, view):
    mo.vstack([view, mo.ui.anywidget(picture)])
    return


@app.cell
def layout_side(
    again, ball, boundary, browser, confirm, damping, density, dof, exclude, fiducials, fit, forget,
    get_point, high, ldv, leave_out, look, low, mark, marks_table, measure_button, name, open_report, other,
    pen, points, radius, registration, remove_mark, reset, search, seed, set_mark, side, spacing, undo,
):  # fmt: skip
    _at = get_point()
    where = mo.md("click in a slice" if _at is None else f"scan {_at[0]:.3f}, {_at[1]:.3f}, {_at[2]:.3f} mm")
    search_tools = mo.accordion(
        {
            "Another body was found, or none": listed(
                where, seed, mo.md("A box to search: the crosshair"), beside(low, high), forget, search
            )
        }
    )
    steps = {
        "1 Scan": listed(browser, beside(name, density), beside(side, spacing), measure_button, search_tools),
        "2 Cut": listed(pen, beside(radius, ball), boundary, beside(undo, reset), again),
        "3 Marks": listed(where, mark, beside(set_mark, remove_mark), marks_table),
        "4 Measurement": listed(ldv, points, fiducials, look, registration, leave_out),
        "5 Fit": listed(dof, damping, exclude, confirm, fit, beside(open_report, other)),
    }
    _steps = mo.accordion(steps, multiple=True, expanded=["1 Scan"])
    mo.Html(f'<div class="steps"><h1>stapeskit</h1>{_steps}</div>')
    return


@app.cell
def layout_mass(get_mass, get_undone, session):
    get_mass(), get_undone()
    mo.Html(tables.html_table(tables.mass_rows(session.masses)))
    return


@app.cell
def layout_beams(measured):
    mo.Html(tables.folded("beams", tables.html_table(tables.beam_rows(measured)))) if measured else mo.md("")
    return


@app.cell
def layout_fit(get_fit, session):
    get_fit()
    fitted = session.content("fit")
    mo.vstack(
        [
            mo.Html(tables.verdict_html(fitted["verdict"])),
            mo.Html(tables.html_table(tables.fit_rows(fitted))),
            mo.hstack(tables.curves(fitted), wrap=True, justify="start"),
            mo.Html(tables.repeat_html(session.places.out, session.study.path)),
        ]
    ) if fitted else mo.md("")
    return


@app.cell
def layout_compare(attempt, other, session):
    def rows():
        from pipeline.compare import compare

        names = ("", "this", other.value, "difference", "p")
        found = compare(session.places.out, session.places.out.with_name(other.value))
        return tables.html_table([dict(zip(names, row, strict=True)) for row in found.rows()])

    compared = []
    if other.value:
        attempt(lambda: compared.append(rows()))
    mo.Html("".join(compared))
    return


@app.cell
def clock(get_busy):
    tick = mo.ui.refresh(default_interval=1) if get_busy() else None
    return (tick,)


@app.cell
def progress(
    get_said, session, set_busy, set_fit, set_marks, set_mass, set_picture, set_points, set_said, tick, up
):
    changed = {
        "found": (set_mass, set_picture),
        "cut": (set_mass,),
        "points": (set_points, set_marks),
        "fit": (set_fit, set_mass),
    }

    def status():
        kind, text = get_said()
        job = session.job
        if tick is None or job is None:
            return kind, mo.Html(text) if text.startswith("<") else mo.md(tables.escape(text))
        if job.running:
            share = f' value="{job.share:.3f}"' if job.share is not None else ""
            hidden = mo.Html(f'<div class="clock">{tick}</div>')
            stop = mo.ui.button(label="Stop", on_click=lambda _: job.stop())
            bar = mo.Html(f"<progress{share}></progress> {tables.escape(job.progress)}")
            return "", mo.hstack([bar, stop, hidden], justify="start")
        fault = session.finish()
        if fault:
            set_said(("danger", fault))
        else:
            notices = tables.notices_text(job.notices)
            set_said(("", f"<div>{tables.done_text(job.step, job.seconds)} {notices}</div>"))
            up(*changed[job.step])
        set_busy(False)
        return "", mo.md("")

    _kind, _shown = status()
    mo.Html(f'<div class="status {_kind}">{_shown}</div>')
    return


if __name__ == "__main__":
    app.run()
