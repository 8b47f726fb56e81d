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
    from html import escape
    from pathlib import Path

    import marimo as mo

    from app import tables
    from app.drawing import PENS
    from app.grey import beneath, first_look
    from app.picture import VIEWS, Picture
    from app.session import Session
    from fitting.options import COMPARE, DAMPING, KDOptions
    from pipeline.new_study import ASSUMED_DENSITY
    from stapeskit.command import fault_sentence
    from stapeskit.faults import StapeskitError
    from stapeskit.report import page

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
            up(*setters)
        except Exception as error:
            danger, text = True, fault_sentence(error)
            if text is None:
                traceback.print_exc(file=sys.stderr)
                text = "stapeskit failed here. This is a bug: please report the lines in the terminal."
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
def study_controls(attempt, session):
    def stated(table, key):
        return session.study.get(table, key) if session.study else None

    def put(table, key, value):
        attempt(lambda: session.opened_study.put(table, **{key: value}))

    def as_words(value):
        """Write a value as a person types it: 900-1000, 1980-2020."""
        parts = value if isinstance(value, list) else [value]
        return ", ".join("-".join(map(str, one)) if isinstance(one, list) else str(one) for one in parts)

    def text_field(table, key, label, default="", several=False, **more):
        """Make a field that shows a key of the study and writes it."""
        value = stated(table, key)

        def typed(words):
            put(table, key, [one for one in words.split(",") if one] if several else words)

        shown_text = default if value is None else as_words(value)
        return mo.ui.text(shown_text, label=label, on_change=typed, **more)

    def ticks(table, key, label, options, value):
        """Make a list of which several can be ticked."""
        return mo.ui.multiselect(
            options, value=value, label=label, full_width=True,
            on_change=lambda names: put(table, key, list(names)),
        )  # fmt: skip

    def button(label, action, *setters, **more):
        """Make a button; what it does may fail."""
        return mo.ui.button(label=label, on_click=lambda _: attempt(action, *setters), **more)

    return button, put, stated, text_field, ticks


@app.cell
def scan_controls(
    attempt, begin, browser, button, get_study, picture, session, set_study, stated, text_field
):
    get_study()
    name = mo.ui.text(
        session.study.path.stem if session.study else "", label="name",
        on_change=lambda value: attempt(lambda: session.rename(value)),
    )  # fmt: skip
    density = mo.ui.text(str(stated("scan", "density_kg_m3") or ASSUMED_DENSITY), label="density, kg/m³")
    side = mo.ui.dropdown(
        ["left", "right"], value=stated("study", "side") or stated("scan", "side"), label="side"
    )
    spacing = text_field("scan", "spacing_mm", "voxel, mm", placeholder="from the scan")

    def measure():
        begin("found", lambda: session.set_scan(density.value, side.value))

    def put_seed():
        session.put_search(seed_mm=[round(float(value), 4) for value in picture.clicked()])

    search_tools = {
        "Another body was found, or none": listed(
            button("Crosshair is in the stapes", put_seed, set_study),
            mo.md("A box to search: the crosshair"),
            beside(
                button("is one corner", lambda: session.put_box_corner(0, picture.clicked()), set_study),
                button(
                    "is the other corner", lambda: session.put_box_corner(1, picture.clicked()), set_study
                ),
            ),
            button("Forget both", session.forget_search, set_study),
            mo.md(session.search_text()),
        )
    }
    scan_step = listed(
        browser, beside(name, density), beside(side, spacing),
        mo.ui.button(label="Measure", kind="success", on_click=lambda _: measure()),
        mo.accordion(search_tools),
    )  # fmt: skip
    return (scan_step,)


@app.cell
def cut_controls(begin, button, picture, session, set_undone):
    def back():
        session.reset()
        picture.show_all()

    pen = mo.ui.radio(
        {"look": None, **PENS}, value="look", inline=True,
        on_change=lambda value: setattr(picture, "pen", value),
    )  # fmt: skip
    radius = mo.ui.slider(
        1, 15, value=3, label="radius, voxels", show_value=True,
        on_change=lambda value: setattr(picture, "radius", value),
    )  # fmt: skip
    ball = mo.ui.switch(
        True, label="ball (off: this slice)", on_change=lambda value: setattr(picture, "ball", value)
    )
    boundary = mo.ui.switch(False, label="boundary only", on_change=picture.show_boundary)
    undo = button("Undo", lambda: picture.show_change(session.undo()), set_undone)
    again = mo.ui.button(label="Measure again", kind="success", on_click=lambda _: begin("cut"))
    reset = button("Back to the cut as found", back, set_undone)
    cut_step = listed(pen, beside(radius, ball), boundary, beside(undo, reset), again)
    view = mo.ui.radio(VIEWS, value=VIEWS[0], inline=True, on_change=picture.set_view)
    return cut_step, view


@app.cell
def mark_controls(button, get_points, get_study, picture, session, set_marks):
    get_study(), get_points()  # the names come from the fiducials of the study

    def put_mark(place):
        if session.marks is None:
            raise StapeskitError("Choose a scan first.")
        session.marks.put(mark.value, place)

    names = session.marks.names if session.marks else ["anterior"]
    mark = mo.ui.dropdown(names, value=names[0], label="the crosshair is at")
    set_mark = button("Set mark", lambda: put_mark(picture.clicked()), set_marks)
    marks_step = listed(mark, beside(set_mark, button("Remove it", lambda: put_mark(None), set_marks)))
    return (marks_step,)


@app.cell
def measurement_controls(attempt, begin, get_points, get_study, session, set_points, stated, ticks):
    get_study(), get_points()

    def pick(key, label):
        files, value = session.files(), stated("ldv", key)
        chosen = value[0] if isinstance(value, list) else value
        return mo.ui.dropdown(
            files, value=chosen if chosen in files else None, allow_select_none=True, label=label,
            on_change=lambda name: attempt(lambda: session.set_measurement(key, name), set_points),
        )  # fmt: skip

    measured = session.content("points")
    measurement_step = listed(
        pick("file", "vibrometer file"), pick("points", "points"), pick("fiducials", "fiducials"),
        mo.ui.button(label="Look at it", kind="success", on_click=lambda _: begin("points")),
        mo.md(tables.registration_text(measured) if measured else ""),
        ticks("ldv", "leave_out", "leave out", *session.leave_out_choice()),
    )  # fmt: skip
    return measured, measurement_step


@app.cell
def fit_controls(begin, button, get_fit, get_study, put, session, stated, text_field, ticks):
    get_study(), get_fit()
    keys, laws = {entry.key: entry for entry in KDOptions.entries()}, [*DAMPING, COMPARE]
    damping = mo.ui.dropdown(
        laws, value=stated("fit", "damping") or laws[0], label="damping",
        on_change=lambda value: put("fit", "damping", value),
    )  # fmt: skip
    other = mo.ui.dropdown(session.other_results(), label="beside it", allow_select_none=True)
    fit_step = listed(
        text_field("fit", "dof", "degrees of freedom", ",".join(keys["dof"].default)),
        damping,
        text_field("fit", "exclude_hz", "leave out, Hz", several=True, placeholder="900-1000, 1980-2020"),
        ticks("study", "confirmed", "checked and right", *session.reasons()),
        mo.ui.button(label="Fit", kind="success", on_click=lambda _: begin("fit")),
        beside(button("Open the report", lambda: webbrowser.open(session.report().as_uri()) and None), other),
    )
    return fit_step, other


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
    marks_table = mo.Html(tables.mark_table(placed)) if placed else None
    return (marks_table,)


@app.cell
def show_points(measured, picture):
    picture.show_points(measured["beams"] if measured and measured["in_scan"] else [])
    return


@app.cell
def layout_picture(picture, view):
    mo.vstack([view, mo.ui.anywidget(picture)])
    return


@app.cell
def layout_point(get_point):
    _at = get_point()
    mo.md("click in a slice" if _at is None else f"scan {_at[0]:.3f}, {_at[1]:.3f}, {_at[2]:.3f} mm")
    return


@app.cell
def layout_side(cut_step, fit_step, marks_step, marks_table, measurement_step, scan_step):
    _steps = {
        "1 Scan": scan_step,
        "2 Cut": cut_step,
        "3 Marks": listed(marks_step, marks_table),
        "4 Measurement": measurement_step,
        "5 Fit": fit_step,
    }
    _shown = mo.accordion(_steps, multiple=True, expanded=["1 Scan"])
    mo.Html(f'<div class="steps"><h1>stapeskit</h1>{_shown}</div>')
    return


@app.cell
def layout_mass(get_mass, get_undone, session):
    get_mass(), get_undone()
    mo.Html(tables.mass_table(session.masses)) if session.masses else mo.md("")
    return


@app.cell
def layout_beams(measured):
    mo.Html(tables.beam_table(measured)) if measured else mo.md("")
    return


@app.cell
def layout_fit(get_fit, session):
    get_fit()
    fitted = session.content("fit")
    mo.vstack(
        [
            mo.Html(fitted["html"]),
            mo.hstack(tables.curves(fitted), wrap=True, justify="start"),
            mo.Html(page.text(session.repeat_text())),
        ]
    ) if fitted else mo.md("")
    return


@app.cell
def layout_compare(attempt, other, session):
    def rows():
        from pipeline.compare import compare

        found = compare(session.study.out, session.study.out.with_name(other.value))
        return page.table(("", "this", other.value, "difference", "p"), found.rows())

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
            return kind, mo.Html(text) if text.startswith("<") else mo.Html(page.text(text))
        if job.running:
            share = f' value="{job.share:.3f}"' if job.share is not None else ""
            hidden = mo.Html(f'<div class="clock">{tick}</div>')
            stop = mo.ui.button(label="Stop", on_click=lambda _: job.stop())
            bar = mo.Html(f"<progress{share}></progress> {escape(job.progress)}")
            return "", mo.hstack([bar, stop, hidden], justify="start")
        fault = session.finish()
        if fault:
            set_said(("danger", fault))
        else:
            set_said(("", f"<div>{job.done} {tables.notice_list(job.notices)}</div>"))
            up(*changed[job.step])
        set_busy(False)
        return "", mo.md("")

    _kind, _shown = status()
    mo.Html(f'<div class="status {_kind}">{_shown}</div>')
    return


if __name__ == "__main__":
    app.run()
