"""The page in which the browser runs Streamlit, told where Streamlit is.

By itself Streamlit's page asks for its server below the address that was opened
(`/compare/_stcore/health`) before it asks at the root: two errors in the console of each visit.
"""

from collections.abc import Sequence
from pathlib import Path

from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route
from streamlit import file_util

_WHERE = """<head>
    <script>
      const origin = location.origin;
      window.__streamlit = { BACKEND_BASE_URL: origin, MAIN_PAGE_BASE_URL: origin };
    </script>"""


def page_routes(paths: Sequence[str]) -> list[Route]:
    """The shell at the address of every page."""
    content = html()

    def page(_: Request) -> Response:
        return HTMLResponse(content, headers={"Cache-Control": "no-cache"})

    return [Route(f"/{path}", page) for path in paths]


def html() -> str:
    """Streamlit's page with the studio's line in its head."""
    return Path(file_util.get_static_dir(), "index.html").read_text().replace("<head>", _WHERE, 1)
