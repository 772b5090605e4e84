"""An open page costs nothing while nothing trains."""

import pytest
from streamlit.proto.ForwardMsg_pb2 import ForwardMsg
from streamlit.runtime.scriptrunner_utils.script_run_context import ScriptRunContext
from studio_pages import draw

pytestmark = pytest.mark.usefixtures("studio")


REPEATING = {"live": [5.0], "replays": [4.0]}
"""seconds between two looks, which draw nothing, at what may have begun elsewhere"""


@pytest.mark.parametrize(
    "view", ["live", "compare", "weights", "regions", "replays", "probe", "studies"]
)
def test_a_page_at_rest_redraws_nothing(view: str, monkeypatch: pytest.MonkeyPatch) -> None:
    intervals = []
    enqueue = ScriptRunContext.enqueue

    def noted(context: ScriptRunContext, message: ForwardMsg) -> None:
        if message.HasField("auto_rerun"):
            intervals.append(message.auto_rerun.interval)
        enqueue(context, message)

    monkeypatch.setattr(ScriptRunContext, "enqueue", noted)
    draw(view)
    assert intervals == REPEATING.get(view, [])
