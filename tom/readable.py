"""Numbers and settings as people read them, on pages, in reports, in terminals, and give them."""

import math
from argparse import ArgumentTypeError
from collections.abc import Callable, Mapping
from typing import Any, TypeGuard

UNKNOWN = "-"

Settings = Mapping[str, str]
"""a configuration by dotted path, each value as text"""


def number(value: float | None, digits: int = 1) -> str:
    """A number with `digits` decimals; a dash if it is unknown or not finite."""
    return f"{value:,.{digits}f}" if _known(value) else UNKNOWN


def short(value: float | None, digits: int = 3) -> str:
    """A measure with so many significant digits; a dash if it is unknown or not finite."""
    if not _known(value):
        return UNKNOWN
    whole = 10**digits <= abs(value) < 10**12
    return f"{value:,.0f}" if whole else f"{value:,.{digits}g}"


def score(value: float | None) -> str:
    """A return: one decimal, or three significant digits if it is less than 1."""
    return short(value) if _known(value) and 0 < abs(value) < 1 else number(value)


def percent(share: float | None, digits: int = 1) -> str:
    """`0.25` -> `25.0 %`; a dash if it is unknown or not finite."""
    return f"{number(100 * share, digits)} %" if _known(share) else UNKNOWN


def factor(value: float) -> str:
    """`0.25` -> `1/4`, `4` -> `4`."""
    return f"1/{1 / value:g}" if 0 < value < 1 else f"{value:g}"


def size(count: float) -> str:
    """Bytes in MB, or in GB from one on."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"


def duration(seconds: float | None) -> str:
    """`75` -> `1 min 15 s`; a dash if it is unknown."""
    if not _known(seconds) or seconds < 0:
        return UNKNOWN
    whole = round(seconds)
    hours, minutes = divmod(whole // 60, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {whole % 60:02d} s" if minutes else f"{whole} s"


def cell(value: object) -> str:
    """A value of a table: four significant digits of a number; a dash if it is unknown."""
    if value is None:
        return UNKNOWN
    return short(value, 4) if isinstance(value, float) else str(value)


def task_title(env: str) -> str:
    """A task's name for a heading: `inverted-pendulum` becomes Inverted pendulum."""
    if ":" in env:
        return env
    return "HalfCheetah" if env == "halfcheetah" else env.replace("-", " ").capitalize()


def flat(nested: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Every value by its dotted path, in order; an empty group has none."""
    values: dict[str, Any] = {}
    for name, value in nested.items():
        inner = isinstance(value, Mapping)
        values |= flat(value, f"{above}{name}.") if inner else {f"{above}{name}": value}
    return values


def in_words(config: object) -> dict[str, str]:
    """A configuration as path: text (`sac.lr`: `0.0003`); empty if it is not a mapping."""
    values = flat(config) if isinstance(config, Mapping) else {}
    return {path: str(value).lower() for path, value in values.items()}


def whole(least: int, most: float = math.inf) -> Callable[[str], int]:
    """The type of an option: a whole number from `least` to `most`."""

    def parse(text: str) -> int:
        if text.isdecimal() and least <= int(text) <= most:
            return int(text)
        bounds = f"{least} or more" if most == math.inf else f"{least} to {most}"
        raise ArgumentTypeError(f"'{text}' must be a whole number, {bounds}")

    return parse


def _known(value: float | None) -> TypeGuard[float]:
    return value is not None and math.isfinite(value)
