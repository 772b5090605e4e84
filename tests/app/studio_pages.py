"""Draws a page without a browser and reads the numbers that its figures show."""

import base64
import io
import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any, Protocol

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import pytest
from kernel import wait_for
from streamlit.testing.v1 import AppTest

from app.links import Links
from app.parts import plot
from app.scenes.control import Selection, clock, listen
from app.servers.browser import chromium
from tom.record.reader import RunReader

TIMEOUT_S = 60
PAGE = """
from app.parts import address
from app.router import VIEWS, draw

[view] = [view for view in VIEWS if view.name == "{view}"]
address.enter_page(view.PATH)
draw(view.page)
"""


class Show(Protocol):
    """The fixture `show`: pages of this process show this store to a browser with the key."""

    def __call__(self, store: Path, key: str = "key", **more: Any) -> None: ...


def set_links(links: Links, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages of this process are those of the studio at `links`."""
    for name, value in links.environment().items():
        monkeypatch.setenv(name, value)


def hear(control: str, select: Callable[[str, Selection], None]) -> None:
    """Listen on the socket as a scene server does, from now on."""

    def answers() -> bool:  # the socket's file is there a moment before
        with suppress(FileNotFoundError, ConnectionRefusedError):
            clock(control, "a page")
            return True
        return False

    Thread(target=listen, args=(control, select, lambda _: None), daemon=True).start()
    wait_for(answers)


def draw(view: str, **query: str | list[str]) -> AppTest:
    """The page of `app.views.<view>` with these query parameters, after its first run."""
    app = AppTest.from_string(PAGE.format(view=view), default_timeout=TIMEOUT_S)
    for name, value in query.items():
        app.query_params[name] = value
    app.run()
    assert not app.exception, app.exception[0].message
    return app


in_buffer = partial(draw, "attention", rows="true")
on_one_buffer = partial(draw, "attention", part="Every learner on one buffer")


def numbers_behind(**query: str) -> AppTest:
    """Answer with its numbers opened."""
    return draw("answer", numbers="true", **query)


def captions(app: AppTest) -> str:
    """All captions of the page, as they are read."""
    return plain("\n".join(part.value for part in app.caption))


def plain(markdown: str) -> str:
    """Markdown without what escapes it, and with common spaces."""
    return markdown.replace("\\", "").replace("\u00a0", " ")


def metrics(app: AppTest) -> dict[str, str]:
    """The page's single numbers by their labels."""
    return {metric.label: metric.value for metric in app.metric}


def recorded(
    store: Path, run_id: str, metric: str = "eval/return"
) -> tuple[list[int], list[float]]:
    """The steps and values of a metric, as the run's record has them."""
    rows = RunReader(store / run_id).metrics()[["env_step", metric]].dropna()
    return rows["env_step"].tolist(), rows[metric].tolist()


def figures(app: AppTest) -> list[dict[str, Any]]:
    """Every Plotly figure of the page, top to bottom."""
    charts = [part.proto for part in app.get("bidi_component") if is_chart(part.proto)]
    return [json.loads(json.loads(chart.json)["figure"]) for chart in charts]


def parts(app: AppTest, name: str) -> list[dict[str, Any]]:
    """What the page's components of a name were given."""
    protos = [part.proto for part in app.get("bidi_component")]
    return [json.loads(proto.json) for proto in protos if proto.component_name == name]


def map_of(app: AppTest) -> dict[str, Any]:
    """What the page gives to the buffer's map."""
    [part] = parts(app, "tom_map")
    return part["given"]


def is_chart(proto: Any) -> bool:
    return proto.component_name == "tom_plot"


def array(values: Any) -> np.ndarray:
    """Numbers of a figure: a list, or Plotly's packed form."""
    if not isinstance(values, dict):
        return np.array([np.nan if value is None else value for value in values])
    flat = np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"])
    shape = values.get("shape")
    return flat.reshape([int(n) for n in str(shape).split(",")]) if shape else flat


def trace(figure: dict[str, Any], **wanted: str) -> dict[str, Any]:
    """The first trace of a figure with these properties."""
    return next(t for t in figure["data"] if all(t.get(k) == v for k, v in wanted.items()))


def in_browser(test: Callable[..., None]) -> Callable[..., None]:
    """Marks a test that needs Chromium."""
    here = pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium")
    return pytest.mark.browser(here(test))


CSV_OF = """() => {
%s
const { data, layout } = %s;
const usual = { visible: true, xaxis: "x", yaxis: "y" };
const _fullData = data.map((trace, i) => ({ ...usual, name: `trace ${i}`, ...trace }));
return csv({ layout, _fullLayout: layout, _fullData });
}"""


def saved(figure: go.Figure) -> pd.DataFrame:
    """The CSV that the page's script makes of a figure, in a browser."""
    traces: list[Any] = list(figure.data)
    shown = {
        "data": [trace.to_plotly_json() for trace in traces],
        "layout": figure.to_dict()["layout"] | {"template": None},
    }
    script = (Path(plot.__file__).with_name("plot.js")).read_text()
    program = CSV_OF % (
        script.replace("export default", "const part ="),
        json.dumps(shown, default=lambda numbers: numbers.tolist()),
    )
    with chromium() as browser:
        return pd.read_csv(io.StringIO(browser.new_page().evaluate(program)))
