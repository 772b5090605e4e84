"""The list of groups and runs beside Compare's figure."""

import re
from pathlib import Path

from app.figures.base import DASHES
from app.parts import eyes

SCRIPT = Path(eyes.__file__).with_name("eyes.js").read_text()


def test_every_dash_of_the_figures_lines_is_drawn_in_the_list() -> None:
    (table,) = re.findall(r"const DASHES = \{(.*?)\};", SCRIPT, re.DOTALL)
    drawn = dict(re.findall(r"(\w+): \"([^\"]*)\"", table))
    assert set(drawn) == set(DASHES)
    assert len(set(drawn.values())) == len(DASHES)
