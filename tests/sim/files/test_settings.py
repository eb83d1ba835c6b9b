"""Settings: types and ranges by annotation, and values read back from JSON."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from sim.files.settings import Interval, NonNegativeFloat, PositiveInt, Share, check_settings, from_builtins, problems


@dataclass(frozen=True, kw_only=True)
class Inner:
    share: Share = 0.5
    span: Interval = (0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Outer:
    count: PositiveInt = 1
    length: float = 0.0
    maybe: NonNegativeFloat | None = None
    names: tuple[str, ...] = ()
    gains: tuple[NonNegativeFloat, ...] | None = None
    file: Path = Path("x")
    inner: Inner = field(default_factory=Inner)


def test_values_within_their_ranges_pass_and_all_problems_are_named_at_once():
    inner, gains = Inner(share=1, span=(2.0, 2.0)), (0.0, np.float64(2.0))
    check_settings(Outer(count=3, length=np.float64(2), maybe=0.0, names=("a",), gains=gains, inner=inner))
    with pytest.raises(ValueError, match=r"count = 0: .*; inner\.share = 2\.0: "):
        check_settings(Outer(count=0, inner=Inner(share=2.0)))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"length": math.inf}, "length"),
        ({"gains": (1.0, math.nan)}, "gains"),
        ({"inner": 3}, "inner"),
        ({"inner": Inner(span=(1.0, 0.0))}, "inner.span"),
    ],
    ids=str,
)
def test_a_wrong_value_is_named(values, field):
    (line,) = problems(Outer(**values))
    assert line.startswith(f"{field} = ")


def test_settings_come_back_from_json():
    inner = {"share": 0, "span": [1, 2]}
    values = {"count": 2, "length": 3, "names": ["a"], "file": "y", "inner": inner, "maybe": None}
    settings = from_builtins(Outer, values, "outer")
    assert settings == Outer(count=2, length=3, names=("a",), file=Path("y"), inner=Inner(share=0, span=(1, 2)))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        (7, "outer"),
        ({"inner": {"colour": 3}}, r"inner\.colour.* share, span"),
        ({"inner": {"span": [1, "a"]}}, r"inner\.span\[1\]"),
        ({"count": 0}, "count"),
        ({"maybe": "x"}, "maybe"),
        ({"inner": {"span": [2, 1]}}, "span"),
    ],
    ids=str,
)
def test_what_json_holds_is_checked(values, field):
    with pytest.raises(ValueError, match=field):
        from_builtins(Outer, values, "outer")
