"""Numbers as people read them."""

from collections.abc import Callable
from math import inf, nan

import pytest

from tom import readable


@pytest.mark.parametrize(
    ("show", "shown"),
    [
        (readable.number, {None: "-", nan: "-", 1234.56: "1,234.6", -0.04: "-0.0"}),
        (readable.score, {None: "-", nan: "-", 0.0: "0.0", 0.0432: "0.0432", 5.32: "5.3"}),
        (readable.score, {-0.5: "-0.5", -1234.56: "-1,234.6"}),
        (readable.duration, {None: "-", 4.4: "4 s", 75: "1 min 15 s", 7260: "2 h 01 min", -1: "-"}),
        (
            readable.short,
            {None: "-", inf: "-", 0.012345: "0.0123", 999.4: "999", 12345.6: "12,346"},
        ),
        (readable.short, {1e15: "1e+15"}),
        (readable.cell, {None: "-", nan: "-", 1.23456: "1.235", 3: "3", "x": "x"}),
        (readable.percent, {None: "-", 0.25: "25.0 %"}),
        (readable.factor, {0: "0", 0.25: "1/4", 1: "1", 4: "4"}),
        (readable.size, {0: "0.0 MB", 25e6: "25.0 MB", 1.5e9: "1.5 GB"}),
    ],
)
def test_what_is_shown(show: Callable[[object], str], shown: dict[object, str]) -> None:
    assert {value: show(value) for value in shown} == shown
