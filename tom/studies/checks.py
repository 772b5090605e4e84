"""The acceptance of a study: a number, its bound, and whether it is met."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Check:
    """One number of an acceptance and its bound."""

    name: str
    value: float
    bound: str
    met: bool


def at_least(name: str, value: float, bound: float) -> Check:
    """Met if `value` is at least `bound`; never for NaN."""
    return Check(name, float(value), f">= {bound:g}", bool(value >= bound))


def at_most(name: str, value: float, bound: float) -> Check:
    """Met if `value` is at most `bound`; never for NaN."""
    return Check(name, float(value), f"<= {bound:g}", bool(value <= bound))
