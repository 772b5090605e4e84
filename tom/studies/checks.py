"""What a study is held against: one figure, its bound, and whether it is met."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Check:
    """One figure of an acceptance and the bound it is held against."""

    name: str
    value: float
    bound: str
    met: bool


def at_least(name: str, value: float, bound: float) -> Check:
    """Met where `value` is `bound` or more; NaN never is."""
    return Check(name, float(value), f">= {bound:g}", bool(value >= bound))


def at_most(name: str, value: float, bound: float) -> Check:
    """Met where `value` is `bound` or less; NaN never is."""
    return Check(name, float(value), f"<= {bound:g}", bool(value <= bound))
