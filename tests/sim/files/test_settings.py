"""Settings: types by annotation, ranges by field, and values read back from JSON."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from sim.files.settings import Allowed, built, check, problems, setting


@dataclass(frozen=True, kw_only=True)
class Inner:
    share: float = setting(0.5, least=0, most=1)
    span: tuple[float, float] = setting((0.0, 1.0), rising=True)


@dataclass(frozen=True, kw_only=True)
class Outer:
    count: int = setting(least=1)
    length: float = setting(1.0, above=0)
    kind: str = setting("one", one_of=("one", "two"))
    maybe: float | None = setting(None, above=0)
    flag: bool = False
    names: tuple[str, ...] = ()
    mode: Literal["fast", "slow"] = "fast"
    file: Path = Path("x")
    inner: Inner = field(default_factory=Inner)


def test_values_within_their_ranges_pass():
    assert problems(Outer(count=1)) == []
    check(Outer(count=3, length=2, maybe=0.1, kind="two", names=("a",), inner=Inner(share=1, span=(2.0, 2.0))))


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"count": 0}, "count must be at least 1, got 0"),
        ({"count": 1.5}, "count must be a whole number, got 1.5"),
        ({"count": True}, "count must be a whole number, got True"),
        ({"length": 0.0}, "length must be above 0, got 0.0"),
        ({"length": math.nan}, "length must be a finite number, got nan"),
        ({"length": "3"}, "length must be a finite number, got '3'"),
        ({"kind": "three"}, "kind must be one of one, two, got 'three'"),
        ({"maybe": -1.0}, "maybe must be above 0, got -1.0"),
        ({"maybe": "x"}, "maybe must be a finite number or None, got 'x'"),
        ({"flag": 1}, "flag must be True or False, got 1"),
        ({"names": ("a", 1)}, "names must be a tuple, each value a text, got ('a', 1)"),
        ({"names": "a"}, "names must be a tuple, got 'a'"),
        ({"mode": "middling"}, "mode must be one of fast, slow, got 'middling'"),
        ({"inner": 3}, "inner must be Inner, got 3"),
        ({"inner": Inner(share=1.5)}, "inner.share must be at least 0 and at most 1, got 1.5"),
        ({"inner": Inner(span=(1.0, 0.0))}, "inner.span must rise, got (1.0, 0.0)"),
        ({"inner": Inner(span=(1.0,))}, "inner.span must have 2 values, got (1.0,)"),
    ],
    ids=str,
)
def test_a_wrong_value_is_named(values, complaint):
    assert problems(Outer(**{"count": 1} | values)) == [complaint]


def test_all_problems_are_named_at_once():
    with pytest.raises(ValueError, match=r"task\.count must .*; task\.length must .*; task\.inner\.share must "):
        check(Outer(count=0, length=-1.0, inner=Inner(share=-1.0)), "task.")


def test_an_unlimited_number_must_still_be_one():
    assert Allowed().complaint(math.inf) == "be a finite number"
    assert Allowed().complaint(-1e30) is None


def test_settings_come_back_from_json():
    values = {"count": 2, "length": 3, "names": ["a", "b"], "inner": {"share": 0, "span": [1, 2]}, "maybe": None}
    found = built(Outer, values, "outer")
    assert found == Outer(count=2, length=3, names=("a", "b"), inner=Inner(share=0, span=(1, 2)))


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        (7, "outer must be an object, got 7"),
        ({"count": 1, "colour": 3}, "outer has no setting colour"),
        ({"count": 1, "inner": {"span": [1]}}, r"span must have 2 values, got \[1\]"),
        ({"count": 1, "inner": {"span": [1, 2, 3]}}, r"span must have 2 values, got \[1, 2, 3\]"),
        ({"count": 1, "names": [1]}, "names must be a text, got 1"),
        ({"count": 2**60, "length": 2**60}, "length must be a finite number"),
    ],
    ids=str,
)
def test_what_json_holds_is_checked(values, complaint):
    with pytest.raises(ValueError, match=complaint):
        built(Outer, values, "outer")
