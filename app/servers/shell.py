"""The page in which the browser runs Streamlit, with Streamlit's address and the studio's key.

Streamlit's own page first looks for its server below the opened address (`/compare/_stcore/health`)
before it tries the root, which gives two errors in the console at each visit. And it makes an entry
of the browser's history whenever the server changes the address.
"""

from collections.abc import Sequence
from pathlib import Path

from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route
from streamlit import file_util

_HEAD = """<head>
    <script>
      {
        const origin = location.origin;
        window.__streamlit = { BACKEND_BASE_URL: origin, MAIN_PAGE_BASE_URL: origin };
        // The key stands behind the # of the address that the terminal printed. It is kept where
        // this port's pages alone read it: a browser gives a cookie to every port of a host.
        const given = /^#key=([\\w-]+)$/.exec(location.hash);
        if (given) {
          localStorage.setItem("tom-studio-key", given[1]);
          history.replaceState(null, "", location.pathname + location.search);
        }
        const key = localStorage.getItem("tom-studio-key");
        // Streamlit keeps a theme for every address; the studio has one for all pages.
        const theme = localStorage.getItem("tom-studio-theme");
        if (theme) {
          localStorage.setItem(`stActiveTheme-${location.pathname}-v2`, JSON.stringify(theme));
        }
        window.WebSocket = class extends window.WebSocket {
          constructor(address, offered) {
            super(address, key ? [...offered, `tom-studio-key.${key}`] : offered);
          }
        };
        // One entry of the history for each act of the visitor: where the page corrects its
        // address by itself, Back would lead to what it corrects again.
        const push = history.pushState.bind(history);
        let acted = false;
        for (const act of ["pointerdown", "keydown"]) {
          addEventListener(act, () => { acted = true; }, { capture: true });
        }
        history.pushState = (...entry) => {
          if (acted) push(...entry);
          else history.replaceState(...entry);
          acted = false;
        };
      }
    </script>"""


def page_routes(paths: Sequence[str]) -> list[Route]:
    """The shell at the address of every page."""
    content = html()

    def page(_: Request) -> Response:
        return HTMLResponse(content, headers={"Cache-Control": "no-cache"})

    return [Route(f"/{path}", page) for path in paths]


def html() -> str:
    """Streamlit's page with the studio's script in its head."""
    return Path(file_util.get_static_dir(), "index.html").read_text().replace("<head>", _HEAD, 1)
