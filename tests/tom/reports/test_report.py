"""The report: one file, nothing fetched, nothing that a name could smuggle in."""

from html.parser import HTMLParser
from pathlib import Path

from tom.reports.figures import new_figure, save
from tom.reports.report import NAME, in_short, write_report


class Links(HTMLParser):
    """Tags, and everything that a page would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.fetched: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.fetched += [value or "" for name, value in attrs if name in ("src", "href")]


def test_a_report_is_one_file_that_fetches_nothing(tmp_path: Path):
    figure = new_figure(2, 2)
    figure.subplots().plot([0, 1])
    png, _ = save(figure, tmp_path, "figure")
    nasty = "<script>alert(1)</script> & \"'"
    write_report(
        tmp_path,
        nasty,
        nasty,
        [nasty],
        [(nasty, png)],
        [(nasty, [{"a": nasty, "b": 1.23456, "c": None, "d": float("nan")}]), ("none", [])],
        {"commit": nasty},
    )
    text = (tmp_path / NAME).read_text()
    links = Links()
    links.feed(text)
    assert "script" not in links.tags
    assert all(link.startswith("data:image/png;base64,") for link in links.fetched)
    assert len(links.fetched) == 1
    assert "<td>1.235</td><td>-</td><td>-</td>" in text
    assert "nothing" in text


def test_seeds_in_short():
    assert in_short([3, 0, 1, 2, 7, 2]) == "0-3, 7"
    assert in_short([]) == ""
