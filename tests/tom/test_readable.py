"""Numbers as people read them."""

import pytest

from tom import readable


@pytest.mark.parametrize(
    ("value", "shown"), [(None, "-"), (float("nan"), "-"), (1234.56, "1,234.6"), (-0.04, "-0.0")]
)
def test_number(value: float | None, shown: str) -> None:
    assert readable.number(value) == shown


@pytest.mark.parametrize(
    ("value", "shown"),
    [(None, "-"), (float("nan"), "-"), (0.0, "0.0"), (0.0432, "0.0432"), (-0.5, "-0.5"),
     (5.32, "5.3"), (-1234.56, "-1,234.6")],
)  # fmt: skip
def test_a_return_that_is_small_keeps_its_digits(value: float | None, shown: str) -> None:
    assert readable.score(value) == shown


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(None, "-"), (4.4, "4 s"), (75, "1 min 15 s"), (7260, "2 h 01 min"), (-1, "-")],
)
def test_duration(seconds: float | None, shown: str) -> None:
    assert readable.duration(seconds) == shown


@pytest.mark.parametrize(
    ("value", "shown"),
    [(None, "-"), (float("inf"), "-"), (0.012345, "0.0123"), (999.4, "999"), (12345.6, "12,346"),
     (1e15, "1e+15")],
)  # fmt: skip
def test_short(value: float | None, shown: str) -> None:
    assert readable.short(value) == shown


@pytest.mark.parametrize(
    ("value", "shown"), [(None, "-"), (float("nan"), "-"), (1.23456, "1.235"), (3, "3"), ("x", "x")]
)
def test_cell(value: object, shown: str) -> None:
    assert readable.cell(value) == shown


def test_shares_factors_and_sizes() -> None:
    assert readable.percent(0.25) == "25.0 %"
    assert readable.percent(None) == "-"
    assert [readable.factor(value) for value in (0, 0.25, 1, 4)] == ["0", "1/4", "1", "4"]
    assert [readable.size(count) for count in (0, 25e6, 1.5e9)] == ["0.0 MB", "25.0 MB", "1.5 GB"]
