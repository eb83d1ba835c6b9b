"""Settings: types and ranges by annotation, and values read back from JSON."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest
import tyro
from msgspec import Meta

from sim.files.settings import (
    Interval,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Share,
    check,
    from_builtins,
    problems,
)


@dataclass(frozen=True, kw_only=True)
class Inner:
    share: Share = 0.5
    span: Interval = (0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Outer:
    count: PositiveInt = 1
    length: PositiveFloat = 1.0
    any_length: float = 0.0
    maybe: NonNegativeFloat | None = None
    few: Annotated[int, Meta(ge=1, le=3)] = 1
    flag: bool = False
    names: tuple[str, ...] = ()
    gains: tuple[NonNegativeFloat, ...] | None = None
    mode: Literal["fast", "slow"] = "fast"
    file: Path = Path("x")
    inner: Inner = field(default_factory=Inner)


def test_values_within_their_ranges_pass():
    inner = Inner(share=1, span=(2.0, 2.0))
    check(Outer(count=3, length=2, maybe=0.0, names=("a",), gains=(0.0, np.float64(2.0)), inner=inner))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"count": 0}, "count"),
        ({"count": 1.5}, "count"),
        ({"count": True}, "count"),
        ({"length": 0.0}, "length"),
        ({"length": np.float64(-1.0)}, "length"),
        ({"any_length": math.nan}, "any_length"),
        ({"any_length": math.inf}, "any_length"),
        ({"any_length": "3"}, "any_length"),
        ({"maybe": -1.0}, "maybe"),
        ({"few": 4}, "few"),
        ({"flag": 1}, "flag"),
        ({"names": ("a", 1)}, "names"),
        ({"names": ["a"]}, "names"),
        ({"gains": (1.0, -1.0)}, "gains"),
        ({"gains": (1.0, math.inf)}, "gains"),
        ({"mode": "middling"}, "mode"),
        ({"file": "x"}, "file"),
        ({"inner": 3}, "inner"),
        ({"inner": Inner(share=1.5)}, "inner.share"),
        ({"inner": Inner(span=(1.0, 0.0))}, "inner.span"),
        ({"inner": Inner(span=(1.0,))}, "inner.span"),
    ],
    ids=str,
)
def test_a_wrong_value_is_named(values, field):
    (line,) = problems(Outer(**values))
    assert line.startswith(f"{field} must ")


def test_a_range_is_said_in_words():
    assert problems(Outer(few=4, length=0.0)) == ["length must be above 0, got 0.0", "few must be at most 3, got 4"]


def test_all_problems_are_named_at_once():
    with pytest.raises(ValueError, match=r"task\.count .*; task\.length .*; task\.inner\.share "):
        check(Outer(count=0, length=-1.0, inner=Inner(share=-1.0)), "task.")


def test_a_command_line_has_flags_of_such_types():
    settings = tyro.cli(Outer, args=["--count", "2", "--gains", "1", "2", "--inner.span", "1", "2", "--maybe", "3"])
    assert settings == Outer(count=2, gains=(1.0, 2.0), inner=Inner(span=(1.0, 2.0)), maybe=3.0)


def test_settings_come_back_from_json():
    values = {
        "count": 2,
        "length": 3,
        "names": ["a"],
        "file": "y",
        "inner": {"share": 0, "span": [1, 2]},
        "maybe": None,
    }
    settings = from_builtins(Outer, values, "outer")
    assert settings == Outer(count=2, length=3, names=("a",), file=Path("y"), inner=Inner(share=0, span=(1, 2)))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        (7, "outer"),
        ({"count": 0}, "count"),
        ({"colour": 3}, "colour"),
        ({"inner": {"colour": 3}}, "colour"),
        ({"inner": {"span": [1]}}, "span"),
        ({"inner": {"span": [2, 1]}}, "span"),
        ({"names": [1]}, "names"),
        ({"any_length": math.nan}, "any_length"),
    ],
    ids=str,
)
def test_what_json_holds_is_checked(values, field):
    with pytest.raises(ValueError, match=field):
        from_builtins(Outer, values, "outer")
