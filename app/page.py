"""The layout of the page of `stapeskit app`, by marimo; session.py does what it offers.

Each tab runs all of this for itself. A widget lives as long as the cell that made it: controls that set a
state do not depend on it, and nothing that lasts depends on the clock.
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
    from pipeline.new_study import LAYOUT, SPACING
    from stapeskit.command import fault_sentence
    from stapeskit.faults import StapeskitError
    from stapeskit.report import page

    folder = Path(mo.cli_args()["folder"] if mo.running_in_notebook() else ".").absolute()
    session, picture = Session(StudyFile(folder / ".none.toml")), Picture()
    get_study, set_study = mo.state(0)  # counters: what depends on one is shown anew when it goes up
    get_picture, set_picture = mo.state(0)
    get_marks, set_marks = mo.state(0)
    get_results, set_results = mo.state(0)
    get_actions, set_actions = mo.state(0)
    get_busy, set_busy = mo.state(False)
    get_point, set_point = mo.state(None)
    get_said, set_said = mo.state(("", tables.status("Choose a scan, or a study to go on with.")))

    def up(*setters):
        """Show anew what depends on these states."""
        for setter in setters:
            setter(lambda count: count + 1)

    def attempt(action, *setters):
        """Do what a control asks for; what is wrong is shown in the library's own words."""
        try:
            kind, text = "", action()
            up(set_actions, *setters)
        except Exception as error:
            kind, text = "danger", fault_sentence(error)
            if text is None:
                traceback.print_exc(file=sys.stderr)
                text = "stapeskit failed here. This is a bug: please report the lines in the terminal."
        said = (kind, tables.status(text or ""))
        set_said(lambda before: said if text or before[0] == "danger" else before)

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

    def stated(table, key):
        """Return what the study says."""
        return session.study.get(table, key)

    def put(table, key, value):
        """Write a key of the study."""
        attempt(lambda: session.study.put(table, **{key: value}))

    def as_words(value):
        """Write a value as a person types it: 900-1000, 1980-2020."""
        parts = value if isinstance(value, list) else [value or ""]
        return ", ".join("-".join(map(str, one)) if isinstance(one, list) else str(one) for one in parts)

    def ticks(table, key, label):
        """Make a list of which several can be ticked, and are then in a key of the study."""
        known, chosen = session.choices(table, key)
        return mo.ui.multiselect(
            known, value=chosen, label=label, full_width=True,
            on_change=lambda names: put(table, key, list(names)),
        )  # fmt: skip

    def listed(*items):
        """Lay items below each other."""
        return mo.vstack([item for item in items if item is not None])

    def beside(*items):
        """Lay items beside each other; they wrap where the page is narrow."""
        return mo.hstack(list(items), wrap=True, justify="start", align="end")

    picture.on_point = set_point
    picture.on_stroke = lambda: attempt(session.end_stroke)


@app.cell
def choose():
    def chosen(files):
        def action():
            return f"{files[0].name} opened. {session.open(Path(files[0].path))}"

        if files:
            attempt(action, set_study, set_picture, set_marks, set_results)

    browser = mo.ui.file_browser(
        initial_path=folder, restrict_navigation=False, selection_mode="all",
        multiple=False, label="A scan, or a study (.toml) to go on with", on_change=chosen,
    )  # fmt: skip
    return (browser,)


@app.cell
def scan_controls(browser):
    get_study()

    def voxel_field(label, example, keys):
        """Make a field of what the scan may not say of its voxels; the scan is opened with it at once."""

        def typed(words):
            parts = words.rsplit(maxsplit=len(keys) - 1) if words.strip() else []
            said = dict.fromkeys(keys) | dict(zip(keys, parts, strict=False))

            def action():
                return session.set_voxels(**said) or "The scan is shown with these voxels."

            attempt(action, set_picture, set_results)

        value = " ".join(as_words(stated("scan", key)) for key in keys).strip()
        return mo.ui.text(value, label=label, placeholder=example, on_change=typed)

    name = mo.ui.text(session.study.path.stem if session.study.text else "", label="name")
    density = mo.ui.text(str(stated("scan", "density_kg_m3") or ASSUMED_DENSITY), label="density, kg/m³")
    side = mo.ui.dropdown(
        ["left", "right"], value=stated("study", "side") or stated("scan", "side"), label="side"
    )
    voxels = [voxel_field("voxel, mm", "as the scan says", SPACING)]
    if session.lacking == LAYOUT:
        voxels.insert(0, voxel_field("voxels x, y, z, type", "512,512,600 uint16", LAYOUT))
    measure = step_button("Measure", "found", lambda: session.set_scan(name.value, density.value, side.value))
    hint = "Another body was found, or none? Mark a place in it, or a box around it, in step 3."
    scan_step = listed(browser, beside(name, density), beside(side, *voxels), measure, mo.md(hint))
    return (scan_step,)


@app.cell
def cut_controls():
    def chooses(name):
        return lambda value: setattr(picture, name, value)

    def takes_back(action):
        """Show what an action changes, and the surfaces where the study's cut is now another one."""

        def taken():
            drawn = session.study.labels_are_ours
            picture.show_change(action())
            if session.study.labels_are_ours != drawn:
                up(set_results)

        return taken

    pen = mo.ui.radio({"look": None, **PENS}, value="look", inline=True, on_change=chooses("pen"))
    radius = mo.ui.slider(
        1, 15, value=3, label="radius, voxels", show_value=True, on_change=chooses("radius")
    )
    ball = mo.ui.switch(True, label="ball (off: this slice)", on_change=chooses("ball"))
    boundary = mo.ui.switch(False, label="boundary only", on_change=picture.show_boundary)
    undo = button("Undo", takes_back(session.undo))
    back = button("Back to the cut as found", takes_back(session.reset))
    again = step_button("Measure again", "cut")
    cut_step = listed(pen, beside(radius, ball), boundary, beside(undo, back), again)
    return (cut_step,)


@app.cell
def mark_controls():
    get_study(), get_results()  # the names come from the fiducials of the study

    mark = mo.ui.dropdown(session.marks.names, value="anterior", label="the crosshair is at")
    set_mark = button("Set mark", lambda: session.marks.put(mark.value, picture.clicked()), set_marks)
    remove = button("Remove it", lambda: session.marks.put(mark.value, None), set_marks)
    marks_step = listed(mark, beside(set_mark, remove))
    return (marks_step,)


@app.cell
def measurement_controls():
    get_study(), get_results()

    def pick(key, label):
        files, value = session.files(), stated("ldv", key)
        chosen = value[0] if isinstance(value, list) else value
        return mo.ui.dropdown(
            files, value=chosen if chosen in files else None, allow_select_none=True, label=label,
            on_change=lambda name: attempt(lambda: session.set_measurement(key, name), set_results),
        )  # fmt: skip

    measurement_step = listed(
        pick("file", "vibrometer file"), pick("points", "points"), pick("fiducials", "fiducials"),
        step_button("Look at it", "points"),
        ticks("ldv", "leave_out", "leave out"),
    )  # fmt: skip
    return (measurement_step,)


@app.cell
def fit_controls():
    get_study(), get_results()
    dof = next(entry for entry in KDOptions.entries() if entry.key == "dof").default
    laws = [*DAMPING, COMPARE]
    other = mo.ui.dropdown(session.other_results(), label="beside it", allow_select_none=True)

    def open_report():
        path = session.study.out / "report.html"
        if not path.is_file():
            raise StapeskitError("There is no report yet: press Fit first.")
        webbrowser.open(path.as_uri())

    fit_step = listed(
        mo.ui.text(as_words(stated("fit", "dof") or ",".join(dof)), label="degrees of freedom",
                   on_change=lambda words: put("fit", "dof", words)),
        mo.ui.dropdown(laws, value=stated("fit", "damping") or laws[0], label="damping",
                       on_change=lambda law: put("fit", "damping", law)),
        mo.ui.text(as_words(stated("fit", "exclude_hz")), label="leave out, Hz",
                   placeholder="900-1000, 1980-2020",
                   on_change=lambda words: put("fit", "exclude_hz", list(filter(None, words.split(","))))),
        ticks("study", "confirmed", "checked and right"),
        step_button("Fit", "fit"),
        beside(button("Open the report", open_report), other),
    )  # fmt: skip
    return fit_step, other


@app.cell
def show_picture():
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
def show_meshes():
    get_marks(), get_results()
    placed, points = session.marks.placed, session.content("measured").get("points", ())
    picture.show_meshes(session.surfaces(), points, list(placed.values()))
    marks_table = mo.Html(tables.mark_table(placed)) if placed else None
    return (marks_table,)


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
def layout_picture():
    mo.vstack([
        mo.ui.radio(VIEWS, value=VIEWS[0], inline=True, on_change=picture.set_view),
        mo.ui.anywidget(picture),
    ])  # fmt: skip
    return


@app.cell
def layout_point():
    _at = get_point()
    mo.md("click in a slice" if _at is None else f"scan {_at[0]:.3f}, {_at[1]:.3f}, {_at[2]:.3f} mm")
    return


@app.cell
def layout_age():
    get_actions(), get_results()
    _old = f"Made before the last change: {', '.join(session.outgrown)}. Do that step again."
    mo.vstack([mo.Html(page.text(_old))] if session.outgrown else [])
    return


@app.cell
def page_choice():
    get_results()
    page_shown = mo.ui.radio(list(session.pages), value=next(iter(session.pages), None), inline=True)
    return (page_shown,)


@app.cell
def layout_results(other, page_shown):
    get_results()
    _parts, _pages = [], session.pages

    def compared():
        from pipeline.compare import compare

        found = compare(session.study.out, session.study.out.with_name(other.value))
        _parts.append(mo.Html(page.table(("", "this", other.value, "difference", "p"), found.rows())))
        _parts.append(mo.Html(page.text(found.remark)))

    if session.mass:
        _parts.append(mo.Html(tables.mass_table(session.mass)))
    if other.value:
        attempt(compared)
    if "K and D" in _pages:
        _again = f"All results: {session.study.out}. Again: scan2kd {shlex.quote(str(session.study.path))}"
        _curves = tables.curves(session.responses)
        _parts += [mo.Html(page.text(_again)), mo.hstack(_curves, wrap=True, justify="start")]
    if _pages:
        _text = _pages[page_shown.value].read_text(encoding="utf-8", errors="replace")
        _parts += [page_shown, mo.iframe(_text, height="90vh")]
    mo.vstack(_parts)
    return


@app.cell
def clock():
    tick = mo.ui.refresh(default_interval=1) if get_busy() else None
    return (tick,)


@app.cell
def progress(tick):
    def status():
        (kind, text), job = get_said(), session.job
        if tick is None or job is None:
            return kind, text
        if job.running:
            share = "" if job.share is None else f' value="{job.share:.3f}"'
            stop = mo.ui.button(label="Stop", on_click=lambda _: job.stop())
            bar = mo.Html(f"<progress{share}></progress> {escape(job.progress)}")
            return "", mo.hstack([bar, stop, mo.Html(f'<div class="clock">{tick}</div>')], justify="start")
        fault = session.finish()
        if fault:
            set_said(("danger", tables.status(fault)))
        else:
            set_said(("", tables.status(job.done, job.notices)))
        up(set_results, *[set_picture] * (job.step == "found"))  # a step that failed may have got far
        set_busy(False)
        return "", ""

    _kind, _shown = status()
    mo.Html(f'<div class="status {_kind}">{_shown}</div>')
    return


if __name__ == "__main__":
    app.run()
