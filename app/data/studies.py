"""What `tom reproduce` left behind: figures, tables and a report for each study."""

import re
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from PIL import Image

FOLDER = Path("reports")
"""where `tom reproduce` puts its results when it is started where the studio was"""
REPORT = "report.html"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
QUESTIONS = {
    "road": "Does TOM drive where offline MBPO does not, because the road counts more?",
    "progression": "Do the weights follow the policy along an ordered buffer?",
    "focus": "Is the model better where the policy goes, and at what price elsewhere?",
    "online": "Which parts of the buffer count at which step of a training?",
    "returns": "Who learns fastest, and who ends highest?",
    "tabular": "Are the estimated weights the exact ones of small MDPs?",
}
"""every study of `tom reproduce`, in the order in which they are listed"""


@dataclass(frozen=True)
class Study:
    """The files of one study."""

    name: str
    figures: tuple[Path, ...]  # PNG
    tables: tuple[Path, ...]  # CSV, the summary first, then the shortest: single values come last
    report: Path | None

    @property
    def question(self) -> str:
        return QUESTIONS.get(self.name, "")


def found(folder: Path = FOLDER) -> list[Study]:
    """The studies with a figure, a table or a report, in the order of `QUESTIONS`."""
    try:
        names = [path.name for path in folder.iterdir() if path.is_dir()]
    except OSError:
        return []
    order = list(QUESTIONS)
    names.sort(key=lambda name: (order.index(name) if name in order else len(order), name))
    studies = [_read(folder / name) for name in names if NAME.fullmatch(name)]
    return [study for study in studies if study and (study.figures or study.tables or study.report)]


def report(name: str, folder: Path = FOLDER) -> Path | None:
    """The report of the study called `name`; None for anything that is not one."""
    return next((study.report for study in found(folder) if study.name == name), None)


def table(path: Path) -> pd.DataFrame | None:
    """The rows of a table; None where it cannot be read."""
    try:
        return pd.read_csv(path)
    except (OSError, ValueError):  # what pandas raises for a damaged file is a ValueError
        return None


def is_picture(path: Path) -> bool:
    """Whether a figure can be shown."""
    try:
        with Image.open(path) as image:
            image.load()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return False
    return True


def _read(folder: Path) -> Study | None:
    """The study in a folder; None where it cannot be listed."""
    try:
        files = [p for p in sorted(folder.iterdir()) if p.is_file() and not p.is_symlink()]
        size = {path: path.stat().st_size for path in files}
    except OSError:  # another user's, or written anew at this moment
        return None
    tables = [path for path in files if path.suffix == ".csv" and size[path]]
    return Study(
        folder.name,
        tuple(path for path in files if path.suffix == ".png"),
        tuple(sorted(tables, key=lambda path: (path.stem != "summary", size[path]))),
        next((path for path in files if path.name == REPORT), None),
    )
