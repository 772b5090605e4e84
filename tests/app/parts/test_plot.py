"""What a chart reports becomes plain values; the page is told where its server is."""

from app.parts import plot
from app.parts.plot import Point, Region, View
from app.servers import pages


def test_a_point_of_a_curve_knows_its_run() -> None:
    told = {"x": 250, "y": 3.5, "index": 7, "meta": "ant-tom-0"}
    assert Point.of(told) == Point(250, 3.5, 7, "ant-tom-0")


def test_a_cell_of_a_heatmap_has_a_row_and_a_column() -> None:
    assert Point.of({"x": 1, "y": 2, "index": [4, 9], "meta": None}).index == (4, 9)


def test_a_region_has_points_and_an_outline() -> None:
    region = Region.of({"points": [[0, 3], [2, 1]], "outline": [[0, 0], [1, 0], [1, 2.5]]})
    assert region.points == ((0, 3), (2, 1))
    assert region.outline == ((0.0, 0.0), (1.0, 0.0), (1.0, 2.5))


def test_a_view_has_the_shown_part_of_each_axis_and_none_for_all_of_it():
    assert View.of({"x": [1, "2.5"], "y": None}) == View((1.0, 2.5), None)


def test_plotly_is_served_from_this_machine() -> None:
    assert plot.LIBRARY.stat().st_size > 1e6
    assert not plot.LIBRARY_PATH.startswith(("/", "http"))  # below any path of a proxy


def test_the_shell_says_where_streamlit_is_before_its_scripts() -> None:
    page = pages.html()
    assert 0 < page.index("BACKEND_BASE_URL") < page.index('<script type="module"')
    assert [route.path for route in pages.page_routes(["", "curves"])] == ["/", "/curves"]
