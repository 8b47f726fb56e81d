"""Contradictions between options: which values break a rule, and what the fault says."""

from __future__ import annotations

import pytest

from legacy.stapeskit.option_declaration import Option
from legacy.stapeskit.option_kinds import FLAG, NUMBER
from legacy.stapeskit.option_rules import Rule, Values, excludes, needs

OPTIONS = (
    Option("box_mm", "box", "scan", "box_mm", NUMBER, "a box"),
    Option("whole", "whole", "scan", "whole", FLAG, "all of it", default=False),
)


def values(**given):
    return Values({"box_mm": None, "whole": False, **given}, OPTIONS)


def test_values_are_found_by_field_and_by_name():
    chosen = values(box_mm=3.0)
    assert (chosen.box, chosen.box_mm) == (3.0, 3.0)
    assert chosen.other is None


def test_a_default_is_not_given():
    assert [entry.name for entry in values(whole=True).given("box", "whole")] == ["whole"]
    assert [entry.name for entry in values(whole=True).missing("box", "whole")] == ["box"]


@pytest.mark.parametrize(
    ("rule", "given", "thing", "got", "next_step"),
    [
        (
            excludes("box", "whole"),
            {"box_mm": 3.0, "whole": True},
            "{box}",
            "3.0",
            "Leave one of the two out",
        ),
        (needs("box", "whole"), {"box_mm": 3.0}, "{box}", "it alone", "Add {whole}"),
        (Rule(lambda v: v.box == 3.0, "{box}", "4", "3", "Add 1"), {"box_mm": 3.0}, "{box}", "3", "Add 1"),
    ],
)
def test_a_broken_rule_is_a_fault_and_a_kept_one_is_none(rule, given, thing, got, next_step):
    fault = rule.fault(values(**given))
    assert (fault.thing, fault.got, fault.next_step) == (thing, got, next_step)
    assert rule.fault(values()) is None
