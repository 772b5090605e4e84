"""Numbers that follow the page's timeline in the browser."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from streamlit.components.v2 import component

_SCRIPT = Path(__file__).with_name("readout.js")
_STYLE = Path(__file__).with_name("readout.css")


@dataclass(frozen=True)
class Number:
    """A labelled number: its text at each of the steps."""

    label: str
    values: Sequence[str]
    help: str = ""


def readout(key: str, steps: Sequence[int], numbers: Sequence[Number]) -> None:
    """Show the numbers at the last of `steps` (ascending) that is not after the timeline's step."""
    data = {"steps": list(steps), "numbers": [asdict(number) for number in numbers]}
    _mount()(key=key, data=data)


@cache
def _mount():
    return component(
        "tom_readout",
        html='<dl class="readout"></dl>',
        css=_STYLE.read_text(),
        js=_SCRIPT.read_text(),
        isolate_styles=False,
    )
