"""The layout of the page of `stapeskit app`, by marimo; session.py does what it offers.

A widget lives as long as the cell that made it: controls that set a state do not depend on it, surfaces have
one cell a group, and none of them depends on the clock.
"""

import marimo

app = marimo.App(width="full", app_title="stapeskit", css_file="page.css")

with app.setup:
    import shlex
    import sys
    import traceback
    import webbrowser
    from html import escape
    from pathlib import Path

    import marimo as mo

    from app import tables
    from app.drawing import PENS
    from app.grey import grey_values
    from app.picture import VIEWS, Picture
    from app.session import Session
    from app.study_file import StudyFile
    from ct_inertia.options import ASSUMED_DENSITY
    from fitting.options import COMPARE, DAMPING, KDOptions
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
    folder = Path(mo.cli_args().get("folder") or ".").absolute()
    session, picture = Session(StudyFile(folder / ".none.toml")), Picture()
    get_study, set_study = mo.state(0)  # counters: what depends on one is shown anew when it goes up
    get_picture, set_picture = mo.state(0)
    get_mass, set_mass = mo.state(0)
    get_marks, set_marks = mo.state(0)
    get_results, set_results = mo.state(0)
    get_busy, set_busy = mo.state(False)
    get_point, set_point = mo.state(None)
    get_said, set_said = mo.state(("", "Choose a scan, or a study to go on with."))
    shown = {"danger": False}

    def up(*setters):
        for setter in setters:
            setter(lambda count: count + 1)

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

    def button(label, action, *setters, **more):
        """Make a button; what it does may fail."""
        return mo.ui.button(label=label, on_click=lambda _: attempt(action, *setters), **more)

    def step_button(label, step, before=lambda: None):
        """Make a button that begins a step."""

        def action():
            before()
            session.start(step)
            set_busy(True)

        return button(label, action, kind="success")

    picture.on_point = set_point
    picture.on_stroke = lambda: attempt(session.end_stroke)
    return (
        attempt, button, get_busy, get_marks, get_mass, get_picture, get_point, get_results, get_said,
        get_study, picture, session, set_busy, set_marks, set_mass, set_picture, set_results, set_said,
        set_study, step_button, up,
    )  # fmt: skip


@app.cell
def choose(attempt, session, set_marks, set_mass, set_picture, set_results, set_study):
    def chosen(files):
        def action():
            return f"{files[0].name} opened. {session.open(Path(files[0].path))}"

        if files:
            attempt(action, set_study, set_picture, set_mass, set_marks, set_results)

    browser = mo.ui.file_browser(
        initial_path=session.study.path.parent, restrict_navigation=False, selection_mode="all",
        multiple=False, label="A scan, or a study (.toml) to go on with", on_change=chosen,
    )  # fmt: skip
    return (browser,)


@app.cell
def study_controls(attempt, session):
    def put(table, key, value):
        attempt(lambda: session.study.put(table, **{key: value}))

    def as_words(value):
        """Write a value as a person types it: 900-1000, 1980-2020."""
        parts = value if isinstance(value, list) else [value]
        return ", ".join("-".join(map(str, one)) if isinstance(one, list) else str(one) for one in parts)

    def text_field(table, key, label, default="", several=False, **more):
        """Make a field that shows a key of the study and writes it."""
        value = session.study.get(table, key)

        def typed(words):
            put(table, key, [one for one in words.split(",") if one] if several else words)

        shown_text = default if value is None else as_words(value)
        return mo.ui.text(shown_text, label=label, on_change=typed, **more)

    def ticks(table, key, label):
        """Make a list of which several can be ticked."""
        known, chosen = session.choices(table, key)
        return mo.ui.multiselect(
            known, value=chosen, label=label, full_width=True,
            on_change=lambda names: put(table, key, list(names)),
        )  # fmt: skip

    return as_words, put, text_field, ticks


@app.cell
def scan_controls(as_words, attempt, browser, get_study, session, set_mass, set_picture, step_button):
    get_study()
    stated = session.study.get

    def typed(words):
        """Open the scan at once with what it may not say of its voxels."""

        def action():
            return session.set_spacing(words.strip() or None) or "The scan is shown with these voxels."

        attempt(action, set_picture, set_mass)

    name = mo.ui.text(session.study.path.stem if session.study.text else "", label="name")
    density = mo.ui.text(str(stated("scan", "density_kg_m3") or ASSUMED_DENSITY), label="density, kg/m³")
    side = mo.ui.dropdown(
        ["left", "right"], value=stated("study", "side") or stated("scan", "side"), label="side"
    )
    spacing = mo.ui.text(
        as_words(stated("scan", "spacing_mm") or ""),
        label="voxel, mm",
        placeholder="as the scan says",
        on_change=typed,
    )
    measure = step_button("Measure", "found", lambda: session.set_scan(name.value, density.value, side.value))
    hint = "Another body was found, or none? Mark a place in it, or a box around it, in step 3."
    scan_step = listed(browser, beside(name, density), beside(side, spacing), measure, mo.md(hint))
    return (scan_step,)


@app.cell
def cut_controls(button, picture, session, step_button):
    def back():
        session.reset()
        picture.show_all()

    def chooses(name):
        return lambda value: setattr(picture, name, value)

    pen = mo.ui.radio({"look": None, **PENS}, value="look", inline=True, on_change=chooses("pen"))
    radius = mo.ui.slider(
        1, 15, value=3, label="radius, voxels", show_value=True, on_change=chooses("radius")
    )
    ball = mo.ui.switch(True, label="ball (off: this slice)", on_change=chooses("ball"))
    boundary = mo.ui.switch(False, label="boundary only", on_change=picture.show_boundary)
    undo = button("Undo", lambda: picture.show_change(session.undo()))
    again, reset = step_button("Measure again", "cut"), button("Back to the cut as found", back)
    cut_step = listed(pen, beside(radius, ball), boundary, beside(undo, reset), again)
    view = mo.ui.radio(VIEWS, value=VIEWS[0], inline=True, on_change=picture.set_view)
    return cut_step, view


@app.cell
def mark_controls(button, get_results, get_study, picture, session, set_marks):
    get_study(), get_results()  # the names come from the fiducials of the study

    mark = mo.ui.dropdown(session.marks.names, value="anterior", label="the crosshair is at")
    set_mark = button("Set mark", lambda: session.marks.put(mark.value, picture.clicked()), set_marks)
    remove = button("Remove it", lambda: session.marks.put(mark.value, None), set_marks)
    marks_step = listed(mark, beside(set_mark, remove))
    return (marks_step,)


@app.cell
def measurement_controls(attempt, get_results, get_study, session, set_results, step_button, ticks):
    get_study(), get_results()

    def pick(key, label):
        files, value = session.files(), session.study.get("ldv", key)
        chosen = value[0] if isinstance(value, list) else value
        return mo.ui.dropdown(
            files, value=chosen if chosen in files else None, allow_select_none=True, label=label,
            on_change=lambda name: attempt(lambda: session.set_measurement(key, name), set_results),
        )  # fmt: skip

    measured = session.content("points")
    measurement_step = listed(
        pick("file", "vibrometer file"), pick("points", "points"), pick("fiducials", "fiducials"),
        step_button("Look at it", "points"),
        mo.md(tables.registration_text(measured) if measured else ""),
        ticks("ldv", "leave_out", "leave out"),
    )  # fmt: skip
    return measured, measurement_step


@app.cell
def fit_controls(button, get_results, get_study, put, session, step_button, text_field, ticks):
    get_study(), get_results()
    keys, laws = {entry.key: entry for entry in KDOptions.entries()}, [*DAMPING, COMPARE]
    damping = mo.ui.dropdown(
        laws, value=session.study.get("fit", "damping") or laws[0], label="damping",
        on_change=lambda value: put("fit", "damping", value),
    )  # fmt: skip
    other = mo.ui.dropdown(session.other_results(), label="beside it", allow_select_none=True)

    def show_report():
        path = session.study.out / "report.html"
        if not path.is_file():
            raise StapeskitError("There is no report yet: press Fit first.")
        webbrowser.open(path.as_uri())

    report = button("Open the report", show_report)
    fit_step = listed(
        text_field("fit", "dof", "degrees of freedom", ",".join(keys["dof"].default)),
        damping,
        text_field("fit", "exclude_hz", "leave out, Hz", several=True, placeholder="900-1000, 1980-2020"),
        ticks("study", "confirmed", "checked and right"),
        step_button("Fit", "fit"),
        beside(report, other),
    )
    return fit_step, other


@app.cell
def show_picture(attempt, get_picture, picture, session):
    get_picture()

    def show():
        drawing = session.drawing
        if session.scan is not None:
            picture.show(*grey_values(session.scan, drawing), drawing)
        elif drawing is not None:
            picture.show(60 * drawing.shown, drawing.affine, drawing)
        else:
            picture.clear()

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
    placed = session.marks.placed
    picture.show_marks(list(placed.values()))
    marks_table = mo.Html(tables.mark_table(placed)) if placed else None
    return (marks_table,)


@app.cell
def show_points(measured, picture):
    picture.show_points(measured["points"] if measured else [])
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
def layout_results(attempt, get_mass, measured, other, session):
    get_mass()
    _parts, _fitted = [], session.content("fit")

    def compared():
        from pipeline.compare import compare

        found = compare(session.study.out, session.study.out.with_name(other.value))
        _parts.append(mo.Html(page.table(("", "this", other.value, "difference", "p"), found.rows())))

    if session.mass:
        _parts.append(mo.Html(tables.mass_table(session.mass)))
    if measured:
        _parts.append(mo.Html(tables.beam_table(measured)))
    if _fitted:
        _parts.append(mo.Html(_fitted["html"]))
        _parts.append(mo.hstack(tables.curves(_fitted["responses"]), wrap=True, justify="start"))
        _again = f"All results: {session.study.out}. Again: scan2kd {shlex.quote(str(session.study.path))}"
        _parts.append(mo.Html(page.text(_again)))
    if other.value:
        attempt(compared)
    mo.vstack(_parts)
    return


@app.cell
def clock(get_busy):
    tick = mo.ui.refresh(default_interval=1) if get_busy() else None
    return (tick,)


@app.cell
def progress(get_said, session, set_busy, set_mass, set_picture, set_results, set_said, tick, up):
    changed = {
        "found": (set_mass, set_picture),
        "cut": (set_mass,),
        "points": (set_results,),
        "fit": (set_results, set_mass),
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
