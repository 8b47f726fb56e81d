"""From ears to laws: logarithms, shared errors, refusals, cohort.json."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest

from legacy import stapeskit
from legacy.pipeline.cohort.cohort_laws import (
    PRIMARY,
    cohort_laws,
    cohort_laws_or_notice,
    planned_law,
    primary_family,
)
from legacy.pipeline.cohort.cohort_page import write_cohort_page
from legacy.pipeline.cohort.compare_ears import ear_table, quantities
from legacy.pipeline.cohort.compatibility import ears_without_sd, faults_of_cohort
from legacy.pipeline.cohort.log_table import log_table
from legacy.pipeline.cohort.power_law import fit_law
from legacy.pipeline.errors import PipelineError
from tests.pipeline.cohort.simulated_ears import ear


def test_the_planted_law_comes_back(studied):
    law = studied.law("K11", "mass").law
    assert law.interval[0] <= 2.0 <= law.interval[1]
    assert law.interval[1] - law.interval[0] < 2.5
    assert law.p_value < 0.01
    assert studied.law("K11", "mass").family == "primary"


def test_the_density_is_shared_and_the_noise_is_not(ears):
    table = log_table(ears)
    assert table.sources == ("density 1900",)
    column, k11 = table.column("mass"), table.column("K11")
    assert table.shared[:, column, 0] == pytest.approx(0.01)
    assert table.shared[:, k11, 0] == pytest.approx(0.01)
    assert table.own[:, column, column] == pytest.approx(0.002**2, rel=1e-3)
    assert table.own[:, k11, k11] == pytest.approx(0.01**2, rel=1e-3)


def test_ears_of_one_calibration_share_its_error_as_they_share_a_density(ears):
    def calibrated(ear, line):
        mass, kd = copy.deepcopy(ear.mass), copy.deepcopy(ear.kd)
        parts = mass["inertial_parameters"]["contributions_si"]
        parts["calibration"] = parts.pop("density")
        kd["budget"]["mass.calibration"] = kd["budget"].pop("mass.density")
        mass |= {"mass_known_by": "calibration", "provenance": {"inputs": {"calibration": {"hash": line}}}}
        return replace(ear, mass=mass, kd=kd)

    one = log_table([calibrated(ear, "a") for ear in ears])
    plain = log_table(ears)
    assert one.sources == ("calibration a",)
    assert one.shared == pytest.approx(plain.shared)
    assert one.own == pytest.approx(plain.own)
    two = log_table([calibrated(ear, "ab"[place % 2]) for place, ear in enumerate(ears)])
    assert two.sources == ("calibration a", "calibration b")
    entries = zip(quantities([calibrated(ear, "a") for ear in ears]), quantities(ears), strict=True)
    assert all(np.array_equal(entry.own, other.own) for entry, other in entries if other.own is not None)


def test_the_state_of_the_density_changes_no_exponent(ears, studied):
    """Half the density in every ear: M, K and D halve, the laws stay."""
    halved = []
    for one in ears:
        mass, kd = copy.deepcopy(one.mass), copy.deepcopy(one.kd)
        record = mass["inertial_parameters"]
        record["values_si"] = (0.5 * np.array(record["values_si"])).tolist()
        record["contributions_si"] = {
            k: (0.25 * np.array(v)).tolist() for k, v in record["contributions_si"].items()
        }
        for key in ("stiffness_si", "damping_si"):
            kd[key] = (0.5 * np.array(kd[key])).tolist()
        kd["covariance_si"] = (0.25 * np.array(kd["covariance_si"])).tolist()
        kd["budget"] = {s: {k: 0.5 * v for k, v in e.items()} for s, e in kd["budget"].items()}
        halved.append(replace(one, mass=mass, kd=kd))
    other = fit_law(log_table(halved).pairs("K11", "mass")[0])
    assert other.exponent == pytest.approx(studied.law("K11", "mass").law.exponent, abs=1e-5)


def test_a_law_on_the_gap_comes_back_with_the_gap_s_own_deviation():
    """K and D as 1 / gap, measured with 3 % of error; the scan states the gap with its deviation."""
    rng = np.random.default_rng(4)
    ears = []
    for number in range(16):
        gap = 0.1 * float(np.exp(0.25 * rng.standard_normal()))
        case = ear(number, rng, exponent=0.0)
        seen = {"gap_mm": gap * (1.0 + 0.03 * rng.standard_normal()), "gap_sd_mm": 0.03 * gap}
        kd = {
            **case.kd,
            **{key: (np.array(case.kd[key]) * 0.1 / gap).tolist() for key in ("stiffness_si", "damping_si")},
        }
        ears.append(replace(case, kd=kd, mass={**case.mass, "found": {**case.mass["found"], **seen}}))
    table = log_table(ears)
    column = table.column("gap")
    assert np.sqrt(table.own[:, column, column]) == pytest.approx(0.03, rel=0.15)
    names = table.full_name("K11"), table.full_name("gap")
    assert names in primary_family(table, PRIMARY)
    law = fit_law(table.pairs(*names)[0])
    assert law.interval[0] <= -1.0 <= law.interval[1] < 0.0


def test_the_record_has_the_keys_of_the_contract(studied, tmp_path, ears):
    content = json.loads(json.dumps(studied.as_json({"date": "today"}), allow_nan=False))
    assert content["schema"] == "stapeskit.cohort/1"
    assert content["ears"] == [one.name for one in ears]
    keys = {
        "response", "predictor", "exponent", "exponent_interval_95", "p_value", "q_value", "intrinsic_sd_log",
        "intrinsic_sd_log_interval_95", "prediction_error_log", "n",
    }  # fmt: skip
    assert all(keys <= set(law) for law in content["laws"])
    assert set(content["independent_parameters"]) >= {"estimate", "interval_95"}
    assert len(repr(studied).splitlines()) < 12
    assert len(studied.to_frame()) == len(studied.laws)
    write_cohort_page(tmp_path / "cohort.html", ears, {}, studied)
    page = (tmp_path / "cohort.html").read_text(encoding="utf-8")
    assert "Independent parameters" in page
    assert len(page) < 3e6


def test_an_unmeasured_ear_is_predicted_from_its_scan(studied):
    rng = np.random.default_rng(99)
    inside = 0
    for number in range(20):
        other = ear(100 + number, rng)
        low, high = studied.predict(other.mass, "K11").interval
        inside += low <= np.log(other.kd["stiffness_si"][0][0]) <= high
    assert inside >= 17
    alone = studied.predict(other.mass)
    assert alone.interval_si[0] < alone.value_si < alone.interval_si[1]
    elsewhere = {**other.mass, "density_kg_m3": 1800.0}
    assert np.ptp(studied.predict(elsewhere).interval) > np.ptp(alone.interval)
    # A mass from a balance is off by itself too, in a cohort of weighed ears.
    weighed = replace(studied, table=replace(studied.table, sources=("mass of ear0",)))
    record = dict(other.mass["inertial_parameters"])
    parts = dict(record["contributions_si"])
    record["contributions_si"] = parts | {"mass": parts.pop("density")}
    balance = {**other.mass, "mass_known_by": "mass", "inertial_parameters": record}
    assert np.ptp(weighed.predict(balance).interval) == pytest.approx(
        np.ptp(studied.predict(elsewhere).interval)
    )
    low, high = studied.tolerance("K11")
    assert low < np.log(1700.0) < high


@pytest.mark.parametrize(
    ("change", "thing"),
    [
        (lambda e: [*e, e[0]], "an ear"),
        (lambda e: [*e, replace(e[0], folder="copy")], "an ear"),
        (lambda e: [*e, replace(e[0], folder="copy", kd={**e[0].kd, "provenance": {}})], "an ear"),
        (lambda e: [replace(e[0], about=e[1].about), *e[1:]], "an ear"),
        (lambda e: [replace(e[0], about={"side": "right"}), *e[1:]], "the side of ear 0"),
        (lambda _: [], "the cohort"),
        (lambda e: [*e[:-1], replace(e[-1], kd={**e[-1].kd, "estimator": "pinv"})], "the estimator"),
        (lambda e: [*e[:-1], replace(e[-1], about={"cochlea": "open"})], "the cochlea"),
        (lambda e: [*e[:-1], replace(e[-1], kd={**e[-1].kd, "dof": ["y"]})], "the degrees of freedom"),
    ],
)
def test_what_does_not_mix_is_refused(ears, change, thing):
    with pytest.raises(PipelineError) as refused:
        cohort_laws(change(ears))
    assert refused.value.faults[0].thing == thing
    told = cohort_laws_or_notice(change(ears), {})
    assert [notice.code for notice in told.notices] == ["cohort_mixed"]
    assert not told.laws


def with_scan(one, scan, **parameters):
    return replace(
        one, mass={**one.mass, "provenance": {"inputs": {"scan": {"hash": scan}}, "parameters": parameters}}
    )


def with_readings(one, *hashes):
    measured = {f"ldv {number}": content for number, content in enumerate(hashes, 1)}
    return replace(one, kd={**one.kd, "provenance": {**one.kd["provenance"], "measured": measured}})


@pytest.mark.parametrize(("hashes", "twice"), [(("b", "a"), True), (("a", "c"), False)])
def test_one_measurement_is_one_ear(ears, hashes, twice):
    members = [with_readings(ears[0], "a", "b"), with_readings(ears[1], *hashes), *ears[2:5]]
    assert bool(faults_of_cohort(members)) is twice


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        (("a", {}), ("a", {"density_kg_m3": [1900.0]}), True),
        (("a", {}), ("b", {}), False),
        (("a", {"seed_mm": [1, 2, 3]}), ("a", {"seed_mm": [9, 2, 3]}), False),
        (("", {}), ("", {}), False),
    ],
)
def test_ears_with_one_scan_are_told(ears, first, second, told):
    members = [
        with_scan(ear_, scan, **parameters)
        for ear_, (scan, parameters) in zip(ears, (first, second), strict=False)
    ]
    codes = {notice.code for notice in cohort_laws([*members, *ears[2:]]).notices}
    assert ("scan_shared" in codes) is told


def test_a_mixture_that_is_asked_for_is_allowed(ears):
    mixed = [*ears[:5], replace(ears[5], kd={**ears[5].kd, "estimator": "pinv"})]
    assert faults_of_cohort(mixed)
    assert not faults_of_cohort(mixed, mix=True)


def test_damping_of_different_units_enters_no_law(ears, tmp_path):
    powers = np.linspace(0.6, 0.9, len(ears))
    fractional = []
    for ear_, power in zip(ears, powers, strict=True):
        model = {"damping_law": "fractional", "damping_exponent": float(power)}
        fractional.append(replace(ear_, kd={**ear_.kd, "model": model}))
    laws = cohort_laws(fractional)
    assert {law.response[0] for law in laws.laws} == {"K"}
    assert "damping_not_comparable" in {notice.code for notice in laws.notices}
    table = ear_table(fractional)
    assert table["damping_exponent"].tolist() == powers.tolist()
    assert "D_y_y_n_s^a_per_m" in table.columns
    write_cohort_page(tmp_path / "cohort.html", fractional, {}, laws)
    with pytest.raises(PipelineError, match="D11"):
        cohort_laws(fractional, planned=(("D11", "mass_kg"),))


def test_the_unit_of_damping_is_that_of_its_law(ears):
    hysteretic = [
        replace(ear_, kd={**ear_.kd, "model": {"damping_law": "hysteretic", "damping_exponent": 0.0}})
        for ear_ in ears
    ]
    assert {"D_y_y_n_per_m", "D_y_alpha_n", "D_gamma_gamma_n_m_per_rad"} <= set(ear_table(hysteretic).columns)


def test_few_ears_stand_side_by_side_only(ears):
    few = cohort_laws(ears[:3], {"ear9": "its scan holds no stapes"})
    assert [notice.code for notice in few.notices] == ["cohort_too_small"]
    assert few.as_json({})["excluded"] == [{"ear": "ear9", "reason": "its scan holds no stapes"}]


def test_an_ear_without_standard_deviations_enters_no_law(ears):
    covariance = np.array(ears[0].kd["covariance_si"])
    covariance[0, 0] = np.nan
    blind = replace(ears[0], kd={**ears[0].kd, "covariance_si": covariance.tolist()})
    none = replace(ears[1], kd={**ears[1].kd, "covariance_si": None})
    assert list(ears_without_sd([blind, none, *ears[2:]])) == ["ear0", "ear1"]
    few = cohort_laws([blind, *ears[1:5]])
    assert [notice.code for notice in few.notices] == ["ear_without_sd", "cohort_too_small"]
    assert [name for name, _ in few.excluded] == ["ear 0"]
    assert len(few.ears) == 5
    both = cohort_laws([none, replace(ears[2], kd={**ears[2].kd, "covariance_si": None}), *ears[3:6]])
    assert [notice.code for notice in both.notices] == ["ear_without_sd", "cohort_too_small"]
    assert both.notices[0].text.startswith("ear 1, ear 2 enter no law")


@pytest.mark.parametrize(
    ("laws", "thing"), [(["K11~colour"], "{laws}"), ([f"K11~J{k}" for k in range(7)], "{laws}")]
)
def test_planned_laws_that_cannot_be_are_refused(ears, laws, thing):
    with pytest.raises(PipelineError) as refused:
        cohort_laws(ears[:5], planned=[planned_law(text) for text in laws])
    assert refused.value.faults[0].thing == thing


def test_an_unknown_law_names_those_there_are(studied):
    with pytest.raises(PipelineError) as refused:
        studied.law("K11", "colour")
    assert "K11 ~ mass_kg" in refused.value.faults[0].expected


def test_folders_of_studies_become_a_cohort(ears, tmp_path):
    for one in ears:
        folder = tmp_path / one.folder
        folder.mkdir()
        (folder / "mass.json").write_text(json.dumps(one.mass), encoding="utf-8")
        (folder / "kd.json").write_text(json.dumps(one.kd), encoding="utf-8")
    found = stapeskit.cohort([tmp_path / one.folder for one in ears], about={"ear1": {"subject": "s"}})
    assert found.law("K11", "mass").law.n == len(ears)
    written = found.write(tmp_path / "out")
    assert sorted(path.name for path in written) == ["cohort.csv", "cohort.html", "cohort.json"]
    assert json.loads((tmp_path / "out" / "cohort.json").read_text(encoding="utf-8"))["laws"]
    with pytest.raises(PipelineError) as refused:
        stapeskit.cohort([tmp_path / "nowhere"])
    assert refused.value.faults[0].thing.endswith("nowhere")


@pytest.mark.parametrize(
    "text", ["[1]", "[" * 100_000, "{}", '{"schema": "stapeskit.mass/1", "frames": 3}', "no JSON"]
)
def test_a_folder_with_other_files_is_named(tmp_path, text):
    for name in ("mass.json", "kd.json"):
        (tmp_path / name).write_text(text)
    with pytest.raises(PipelineError) as caught:
        stapeskit.cohort([tmp_path])
    assert caught.value.faults[0].thing == str(tmp_path)
