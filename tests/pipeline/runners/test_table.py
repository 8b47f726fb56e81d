"""The table of runners: each entry has a module that runs, and an address chooses one."""

import inspect
from importlib import import_module

import pytest

from legacy.pipeline import several_studies
from legacy.pipeline.errors import PipelineError
from legacy.pipeline.runners import HERE, RUNNERS, Run, runner_of


@pytest.mark.parametrize("name", RUNNERS)
def test_every_entry_can_be_called_as_the_interface_says(name):
    run = import_module(f"legacy.pipeline.runners.{name}").run
    wanted = list(inspect.signature(Run.__call__).parameters)[1:]
    assert list(inspect.signature(run).parameters) == wanted
    assert bool(RUNNERS[name].schemes) == (name != HERE)


@pytest.mark.parametrize(
    ("address", "module"), [("", "local"), ("tcp://host:8786", "dask_cluster"), ("host:8786", "dask_cluster")]
)
def test_the_address_chooses_the_runner(address, module):
    assert runner_of(address).__module__ == f"legacy.pipeline.runners.{module}"


def test_an_unknown_scheme_is_refused():
    with pytest.raises(PipelineError) as refused:
        runner_of("ftp://host")
    assert refused.value.faults[0].thing == "{scheduler}"
    assert refused.value.faults[0].got == "ftp://host"


def test_a_study_that_a_runner_says_nothing_of_has_failed(tmp_path, monkeypatch):
    monkeypatch.setattr(several_studies, "runner_of", lambda _address: lambda *_given: None)
    (tmp_path / "a.toml").write_text("", encoding="utf-8")
    result = several_studies.run_studies([tmp_path / "a.toml"], tmp_path / "out")
    assert result.codes == {"a": 2}
    assert "runner" in result.faults["a"]
