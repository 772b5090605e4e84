"""The page is told where its server is, and where the library of its charts."""

from app.parts import plot
from app.servers import pages


def test_plotly_is_served_from_this_machine() -> None:
    assert plot.LIBRARY.stat().st_size > 1e6
    assert not plot.LIBRARY_PATH.startswith(("/", "http"))  # below any path of a proxy


def test_the_shell_says_where_streamlit_is_before_its_scripts() -> None:
    page = pages.html()
    assert 0 < page.index("BACKEND_BASE_URL") < page.index('<script type="module"')
