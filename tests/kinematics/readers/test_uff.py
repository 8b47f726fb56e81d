"""Universal files: every form of the numbers, geometry, units, directions, runs, and files that lie."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyuff

from legacy.kinematics.readers.recognise_format import format_of
from legacy.kinematics.readers.uff.datasets import datasets, looks_like_uff
from legacy.kinematics.readers.uff.functions import read_function
from legacy.kinematics.readers.uff.spectra import read
from legacy.kinematics.readers.unit_labels import MotionUnit, motion_unit
from legacy.stapeskit.faults import StapeskitError
from tests.kinematics import written_uff as uff
from tests.kinematics.readers.recordings import read_recordings

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data" / "uff"
X = np.arange(1, 24) * 12.5
Y = np.random.default_rng(1).normal(size=(23, 2)) @ [1.0, 1.0j] * 1e-4


def written(tmp_path, *parts, name="scan.uff"):
    path = tmp_path / name
    path.write_bytes(b"".join(parts))
    return path


def one(tmp_path, **how):
    """The single recording of a file with one function at node 1."""
    path = written(tmp_path, uff.units(), uff.nodes_15({1: (0.001, 0.002, 0.003)}), uff.function(X, Y, **how))
    (recording,) = read(path).recordings
    return recording


def fault(tmp_path, *parts):
    with pytest.raises(StapeskitError) as caught:
        read(written(tmp_path, *parts))
    text = str(caught.value)
    assert "must be" in text or "must have" in text
    assert text.endswith(".")
    return text


@pytest.mark.parametrize("binary", ["", "<", ">"])
@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("form", [2, 4, 5, 6])
def test_every_form_of_the_numbers(form, even, binary, tmp_path):
    x = X if even else X + np.where(np.arange(23) % 2, 0.5, 0.0)
    content = uff.function(x, Y, form=form, even=even, binary=binary)
    (found,) = datasets(content, "f.uff")
    made = read_function(found, "f.uff")
    exact = form in (4, 6)
    np.testing.assert_allclose(made.x, x, rtol=1e-12 if even or binary else 1e-5)
    tolerance = (1e-12 if exact else 3e-7) if binary else (1e-11 if exact else 1e-5)
    np.testing.assert_allclose(made.y.real, Y.real, rtol=tolerance)
    np.testing.assert_allclose(made.y.imag, Y.imag if form in (5, 6) else 0.0 * Y.real, rtol=tolerance)
    assert made.real == (form in (2, 4))


@pytest.mark.parametrize("form", [4, 6])
def test_double_values_with_a_double_abscissa(form, tmp_path):
    columns = [X, Y.real, Y.imag] if form == 6 else [X, Y.real]
    short = uff.function(X, Y, form=form, even=False, binary="<")
    data = np.column_stack(columns).astype("<f8").tobytes()
    old = len(X) * (4 + 8 * (len(columns) - 1))
    head = short[: short.index(b"NONE                \n", len(short) - old - 60) + 21]
    content = head.replace(f"{old:12d}".encode(), f"{len(data):12d}".encode()) + data + b"    -1\n"
    (found,) = datasets(content, "f.uff")
    np.testing.assert_array_equal(read_function(found, "f.uff").x, X)


def test_bytes_that_look_like_the_end_of_a_dataset_are_values(tmp_path):
    y = np.frombuffer(b"\n    -1\n" * 23, "<f8").astype(complex)
    path = written(
        tmp_path,
        uff.function(X, y, 1, form=6, binary="<", per_unit="V"),
        uff.function(X, Y, 2, form=6, binary="<", per_unit="V"),
    )
    first, second = read(path).recordings
    np.testing.assert_array_equal(first.value.real, y.real)
    np.testing.assert_array_equal(second.value, Y)


@pytest.mark.parametrize("tail", [b"\r\n    -1\r\n", b"\n    -1\n", b"    -1     \n", b"    -1"])
def test_ends_of_binary_datasets_as_programs_write_them(tail, tmp_path):
    content = uff.function(X, Y, form=6, binary=">")
    (recording,) = read(written(tmp_path, content[: -len(b"    -1\n")] + tail)).recordings
    np.testing.assert_array_equal(recording.value, Y)


def test_windows_lines_padding_and_fortran_exponents(tmp_path):
    text = uff.function(X, Y, form=6).replace(b"E", b"D").replace(b"NOND", b"NONE").replace(b"\n", b"   \r\n")
    padded = uff.function(X[:3], Y[:3], 2).replace(b"\n    -1\n", b"  0.00000E+00  0.00000E+00\n    -1\n")
    first, second = read(written(tmp_path, text, padded)).recordings
    np.testing.assert_allclose(first.value, Y, rtol=1e-11)
    np.testing.assert_allclose(second.value, Y[:3], rtol=1e-5)


def test_numbers_without_blanks_between_them(tmp_path):
    y = np.full(3, -1.23456e-4 - 2.5e-4j)
    text = uff.function(X[:3], y)
    text = text.replace(b" -1.23456E-04 -2.50000E-04", b"-1.234560E-04-2.500000E-04")
    assert b"E-04-" in text
    (recording,) = read(written(tmp_path, text)).recordings
    np.testing.assert_allclose(recording.value, y, rtol=1e-6)


def test_position_direction_quantity_and_names(tmp_path):
    recording = one(tmp_path)
    assert (recording.point, recording.order, recording.run) == ("1", 1, "")
    np.testing.assert_allclose(recording.position_mm, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(recording.direction, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(recording.value, Y, rtol=1e-5)
    assert (recording.where.unit, recording.where.numbers) == ("dataset", (3,))


@pytest.mark.parametrize(
    ("code", "expected"), [(1, (1, 0, 0)), (-1, (-1, 0, 0)), (-3, (0, 0, -1)), (2, (0, 1, 0))]
)
def test_signed_directions(code, expected, tmp_path):
    np.testing.assert_array_equal(one(tmp_path, direction=code).direction, expected)


def test_scalars_have_no_direction(tmp_path):
    assert np.all(np.isnan(one(tmp_path, direction=0).direction))


@pytest.mark.parametrize("code", [4, -5, 6, 11])
def test_rotations_and_unknown_codes_are_refused(code, tmp_path):
    text = fault(tmp_path, uff.function(X, Y, direction=code))
    assert "the direction at node 1 must be 0 (scalar) or +-1, +-2, +-3 (translations)" in text


@pytest.mark.parametrize(
    ("quantity", "unit", "order", "scale"),
    [
        (uff.VELOCITY, "m/s", 1, 1.0),
        (uff.VELOCITY, "mm/s", 1, 1e-3),
        (uff.VELOCITY, "µm/s", 1, 1e-6),
        (uff.DISPLACEMENT, "m", 0, 1.0),
        (uff.DISPLACEMENT, "nm", 0, 1e-9),
        (uff.ACCELERATION, "m/s^2", 2, 1.0),
        (uff.ACCELERATION, "m/s²", 2, 1.0),
        (uff.ACCELERATION, "g", 2, 9.80665),
        (uff.ACCELERATION, "mm/s/s", 2, 1e-3),
        (1, "mm/s", 1, 1e-3),
        (uff.VELOCITY, "NONE", 1, 1.0),
    ],
)
def test_quantity_by_its_type_and_unit_by_its_label(quantity, unit, order, scale, tmp_path):
    recording = one(tmp_path, quantity=quantity, unit=unit, kind=uff.SPECTRUM, names=("x", "Weg"))
    assert recording.order == order
    np.testing.assert_allclose(recording.value, Y * scale, rtol=1e-5)
    assert recording.per == ""


def test_values_without_label_are_in_the_length_unit_of_the_file(tmp_path):
    path = written(tmp_path, uff.units(1000.0, 5, "mm (milli newton)"), uff.function(X, Y, unit="NONE"))
    np.testing.assert_allclose(read(path).recordings[0].value, Y * 1e-3, rtol=1e-5)


def test_unknown_or_contradicting_units_are_refused(tmp_path):
    assert '"furlong/s"' in fault(tmp_path, uff.function(X, Y, unit="furlong/s"))
    text = fault(tmp_path, uff.function(X, Y, unit="m", quantity=uff.VELOCITY))
    assert "got velocity (type 11) in m" in text


@pytest.mark.parametrize(
    ("how", "per"),
    [
        ({"per": uff.FORCE, "per_unit": "N"}, "N"),
        ({"per": uff.PRESSURE}, "Pa"),
        ({"per": 0, "per_unit": "V"}, "V"),
        ({"unit": "m/s/V"}, "V"),
        ({"unit": "(m/s)/Pa"}, "Pa"),
        ({"per": uff.VELOCITY, "per_unit": "m/s"}, "m/s"),
        ({}, "unit of the reference"),
    ],
)
def test_responses_know_what_they_are_per(how, per, tmp_path):
    assert one(tmp_path, **how).per == per


def test_coherence_goes_with_its_response(tmp_path):
    coherence = np.linspace(0.0, 1.00005, 23)
    path = written(
        tmp_path,
        uff.function(X, Y, 1, 3),
        uff.function(X, Y, 1, 1),
        uff.function(X, coherence, 1, 3, kind=uff.COHERENCE, quantity=1, unit="NONE", form=2),
    )
    first, second = read(path).recordings
    np.testing.assert_allclose(first.coherence, np.clip(coherence, 0.0, 1.0), rtol=1e-5)
    assert np.max(first.coherence) == 1.0
    assert second.coherence is None
    bad = uff.function(X, coherence * 3.0, 1, 3, kind=uff.COHERENCE, quantity=1, unit="NONE", form=2)
    assert "the coherence must be within 0 and 1" in fault(tmp_path, uff.function(X, Y, 1, 3), bad)
    other = uff.function(X * 1.1, coherence, 1, 3, kind=uff.COHERENCE, quantity=1, unit="NONE", form=2)
    assert "at the frequencies of its response" in fault(tmp_path, uff.function(X, Y, 1, 3), other)


def test_coherence_from_auto_spectra(tmp_path):
    rng = np.random.default_rng(3)
    x = rng.normal(size=(50, 23, 2)) @ [1.0, 1.0j]
    y = (0.3 - 0.2j) * x + 0.2 * rng.normal(size=(50, 23, 2)) @ [1.0, 1.0j]
    gxx, gyy, gxy = (np.mean(a.conj() * b, axis=0) for a, b in ((x, x), (y, y), (x, y)))
    force = {"quantity": uff.FORCE, "unit": "N^2"}
    parts = [
        uff.function(X, gxy / gxx, 1, 3, per=uff.FORCE, per_unit="N", reference=(90, 1), form=6),
        uff.function(X, gyy, 1, 3, kind=uff.AUTO, unit="(m/s)^2", form=4),
        uff.function(X, gxx, 90, 1, kind=uff.AUTO, form=4, **force),
    ]
    whole = read(written(tmp_path, *parts))
    (made,) = whole.recordings
    assert "coherence_computed" in {notice.code for notice in whole.notices}
    np.testing.assert_allclose(made.coherence, np.abs(gxy) ** 2 / (gxx * gyy).real, rtol=1e-9)
    (made,) = read(written(tmp_path, *parts[:2])).recordings
    assert made.coherence is None
    wrong = uff.function(X, gxx * 40.0, 90, 1, kind=uff.AUTO, form=4, **force)
    (made,) = read(written(tmp_path, *parts[:2], wrong)).recordings
    assert made.coherence is None


def test_other_functions_are_left_out_and_counted(tmp_path):
    path = written(
        tmp_path,
        uff.function(X, Y, 1),
        uff.function(X, Y, 1, kind=uff.SPECTRUM),
        uff.function(X, Y, 1, quantity=uff.FORCE, unit="N"),
        uff.function(X, abs(Y), 1, kind=uff.AUTO, form=2),
        uff.function(X, Y.real, 1, kind=uff.TIME, form=2, abscissa=17),
        uff.function(X, Y, 1, quantity=uff.DISPLACEMENT, unit="m"),
    )
    made = read(path)
    assert len(made.recordings) == 1
    assert made.recordings[0].order == 1
    said = {notice.code: notice.text for notice in made.notices}
    assert set(said) == {"function_chosen", "quantity_chosen", "functions_left_out"}
    assert "1 auto spectrum" in said["functions_left_out"]
    assert "1 time response" in said["functions_left_out"]


def test_spectra_alone_warn_of_their_phase(tmp_path):
    made = read(written(tmp_path, uff.function(X, Y, kind=uff.SPECTRUM)))
    assert [notice.code for notice in made.notices] == ["spectra_phase"]


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"kind": uff.TIME, "form": 2, "abscissa": 17}, "--reference-channel"),
        ({"kind": uff.AUTO, "form": 2}, "1 auto spectrum"),
        ({"kind": uff.FRF, "form": 2}, "of real numbers, without phase"),
        ({"quantity": uff.PRESSURE, "unit": "Pa"}, "frequency response function of Velocity"),
        ({"abscissa": 17}, "over Time"),
        ({"kind": uff.COHERENCE, "form": 2}, "coherence"),
    ],
)
def test_files_without_motion_say_what_they_hold(how, words, tmp_path):
    assert words in fault(tmp_path, uff.function(X, Y, **how))


def test_the_reference_names_the_run(tmp_path):
    parts = [uff.function(X, Y, node, 3, reference=ref) for node in (1, 2) for ref in ((90, 1), (91, -3))]
    runs = [(r.point, r.run) for r in read(written(tmp_path, *parts)).recordings]
    assert runs == [("1", "90+x"), ("1", "91-z"), ("2", "90+x"), ("2", "91-z")]
    parts = [uff.function(X, Y, node, 3, load_case=case) for node in (1, 2) for case in (1, 2)]
    assert {r.run for r in read(written(tmp_path, *parts)).recordings} == {"case 1", "case 2"}


def test_a_reference_that_repeats_the_response_names_no_run(tmp_path):
    parts = [uff.function(X, Y, node, 3, reference=(node, 3)) for node in (1, 2, 3)]
    assert {r.run for r in read(written(tmp_path, *parts)).recordings} == {""}


def test_versions_of_one_function_are_repeats(tmp_path):
    parts = [uff.function(X, Y, node, 3, version=version) for node in (1, 2) for version in (1, 2)]
    assert [r.repeat for r in read(written(tmp_path, *parts)).recordings] == ["1", "2", "1", "2"]


def test_one_function_twice_is_refused(tmp_path):
    text = fault(tmp_path, uff.function(X, Y), uff.function(X, Y))
    assert "dataset 1 and scan.uff, dataset 2" in text


def test_geometry_without_functions_and_functions_without_geometry(tmp_path):
    assert "one with functions (dataset 58); got none" in fault(tmp_path, uff.nodes_15({1: (0, 0, 0)}))
    (made,) = read(written(tmp_path, uff.function(X, Y, 4))).recordings
    assert np.all(np.isnan(made.position_mm))


def test_points_by_name_where_the_file_has_no_numbers(tmp_path):
    path = written(tmp_path, uff.function(X, Y, 0, 3, entity="head"), uff.function(X, Y, 0, 3, entity="crus"))
    assert [one.point for one in read(path).recordings] == ["head", "crus"]


@pytest.mark.parametrize("name", ["a.uff", "a.unv", "a.txt", "a"])
def test_universal_files_are_known_by_their_first_lines(name, tmp_path):
    path = written(tmp_path, uff.function(X, Y), name=name)
    assert format_of(path).name == "uff"
    assert read_recordings(path).file == name
    assert not looks_like_uff(b"body,point\n")


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_files_of_another_writer_and_for_another_reader(tmp_path):
    ours = written(
        tmp_path,
        uff.units(),
        uff.nodes_15({1: (0.5, 0.25, 0.125)}),
        uff.function(X, Y, form=6),
        name="ours.uff",
    )
    sets = pyuff.UFF(str(ours)).read_sets()
    np.testing.assert_allclose(sets[2]["data"], Y, rtol=1e-11)
    np.testing.assert_allclose(sets[2]["x"], X)
    assert (sets[2]["rsp_node"], sets[2]["rsp_dir"], sets[2]["ordinate_spec_data_type"]) == (1, 3, 11)
    theirs = tmp_path / "theirs.uff"
    for binary, form in ((0, 5), (0, 6), (1, 5), (1, 6)):
        made = pyuff.prepare_58(
            binary=binary, func_type=4, rsp_node=7, rsp_dir=-2, ref_node=0, ref_dir=0, data=Y, x=X,
            id1="id1", rsp_ent_name="NONE", ref_ent_name="NONE", abscissa_spacing=1,
            abscissa_spec_data_type=18, ordinate_spec_data_type=12, ordinate_axis_units_lab="m/s2",
            orddenom_spec_data_type=13,
        )  # fmt: skip
        made |= {"ord_data_type": form, "abscissa_min": X[0], "abscissa_inc": X[1] - X[0], "num_pts": len(X)}
        theirs.unlink(missing_ok=True)
        pyuff.UFF(str(theirs)).write_sets(made, "add")
        (read_back,) = read(theirs).recordings
        np.testing.assert_allclose(read_back.value, Y, rtol=1e-5)
        np.testing.assert_array_equal(read_back.direction, [0.0, -1.0, 0.0])
        assert (read_back.order, read_back.per, read_back.point) == (2, "N", "7")


@pytest.mark.shared
def test_files_from_measuring_systems():
    (found,) = datasets((SHARED / "Sample_UFF58b_bin.uff").read_bytes(), "f.uff")
    made = read_function(found, "f.uff")
    assert (len(made.y), made.kind, made.ordinate.unit) == (79292, 1, "Pa")
    assert np.all(np.abs(made.y) < 1.0)
    assert float(np.std(made.y.real)) > 1e-4
    for name in ("TestLab 161 164 18 15 82.uff", "heat_engine_housing.uff"):
        with pytest.raises(StapeskitError, match="one with functions"):
            read(SHARED / name)


@pytest.mark.shared
def test_geometry_from_measuring_systems():
    from legacy.kinematics.readers.uff.geometry import read_geometry

    name = "heat_engine_housing.uff"
    made = read_geometry(datasets((SHARED / name).read_bytes(), name), name, set(range(100)))
    np.testing.assert_allclose(made.positions_m[1], [-0.1711755676, 0.1036403427, 0.1384829101], rtol=1e-8)
    name = "TestLab 161 164 18 15 82.uff"
    made = read_geometry(datasets((SHARED / name).read_bytes(), name), name, set(range(1000)))
    assert len(made.positions_m) == 36
    for axes in made.axes.values():
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-6)


@pytest.mark.parametrize(
    "unit", ["m/s/\u221aHz", "(m/s)/sqrt(Hz)", "m/s/Hz^0.5", "(m/s)^2", "m2/s2", "dB", "V", "rad/s", "deg"]
)
def test_what_is_no_amplitude_of_motion_has_no_unit_of_motion(unit):
    assert motion_unit(unit) is None


@pytest.mark.parametrize(
    ("unit", "per"),
    [("m/s/V", "V"), ("(m/s)/(m/s)", "m/s"), ("m/s / Pa", "Pa"), ("(m/s)/N", "N"), ("[ m/s ]", "")],
)
def test_responses_keep_the_unit_of_their_reference(unit, per):
    assert motion_unit(unit) == MotionUnit(1, 1.0, per)
