"""Numbers that follow the page's timeline in the browser."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from app.parts.component import renderer

_HTML = '<dl class="readout"></dl>'


@dataclass(frozen=True)
class Number:
    """A labelled number: its text at each of the steps."""

    label: str
    values: Sequence[str]
    help: str = ""


def readout(key: str, steps: Sequence[int], numbers: Sequence[Number]) -> None:
    """Show the numbers at the last of `steps` (ascending) that is not after the timeline's step."""
    data = {"steps": list(steps), "numbers": [asdict(number) for number in numbers]}
    renderer("readout", _HTML)(key=key, data=data)
