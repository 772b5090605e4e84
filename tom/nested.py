"""Settings as nested dicts, `{"sac": {"lr": 1e-3}}`, and by dotted path, `sac.lr`."""

from collections.abc import Mapping
from typing import Any


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with `changes` on top, group by group."""
    found = dict(base)
    for name, value in changes.items():
        held = found.get(name)
        if isinstance(held, Mapping) and isinstance(value, Mapping):
            found[name] = merged(held, value)
        else:
            found[name] = value
    return found


def flat(nested: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Every value by its dotted path, in order; a group without values has none."""
    found: dict[str, Any] = {}
    for name, value in nested.items():
        inner = isinstance(value, Mapping)
        found |= flat(value, f"{above}{name}.") if inner else {f"{above}{name}": value}
    return found
