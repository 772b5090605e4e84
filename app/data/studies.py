"""The results of `tom reproduce`: figures, tables and a report for each study."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tom.errors import UserError
from tom.record.files import read_json
from tom.record.store import Store
from tom.reports.report import WORDS
from tom.studies import STUDIES, load

FOLDER = Path("reports")
"""the folder of results of `tom reproduce` if it is started in the studio's folder"""
REPORT = "report.html"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True)
class Study:
    """The files of one study, and the text of its report."""

    name: str
    figures: tuple[Path, ...]  # PNG
    tables: tuple[Path, ...]  # CSV, the summary first, then by length: single values come last
    report: Path | None
    claim: str = ""
    """what the paper says"""
    findings: tuple[str, ...] = ()
    """what was found, in sentences"""
    origin: Mapping[str, str] = field(default_factory=dict)

    @property
    def verb(self) -> str:
        """The folder's name, else that of the command, which may have written elsewhere."""
        words = self.origin.get("command", "").split()
        verb = words[2] if words[:2] == ["tom", "reproduce"] and len(words) > 2 else ""
        return self.name if self.name in STUDIES else verb

    @property
    def question(self) -> str:
        return load(self.verb).QUESTION if self.verb in STUDIES else ""

    @property
    def question_key(self) -> str:
        """What studies of one question have in common; other studies stand alone."""
        if any(table.stem == "factors" for table in self.tables):  # model apart from starts
            return f"{self.verb}-apart"
        return self.verb if self.verb in STUDIES else self.name

    @property
    def distinction(self) -> str:
        """What tells it from the others of its question: its name's ending, and its numbers."""
        ending = self.name.removeprefix(self.question_key).strip("-").replace("-", " ")
        # Of returns the number of runs is known, of other studies their names.
        number = self.origin.get("n", f"{self.origin.get('runs', '?')} runs")
        return ", ".join(filter(None, (ending, number)))


def folders(store: Path | str) -> tuple[Path, ...]:
    """The folders of studies: those of this machine, then those in the store."""
    try:
        return FOLDER, Store(store).beside("studies")
    except UserError:  # a link, which is named among what is no run
        return (FOLDER,)


def listing(*places: Path) -> list[Study]:
    """The studies with a figure, a table or a report, in the order of `STUDIES`.

    A study in several places is taken from the first that has any of these.
    """
    found: dict[str, Study] = {}
    for folder in (folder for place in places for folder in _files(place, Path.is_dir)):
        if folder.name not in found and NAME.fullmatch(folder.name):
            study = _read(folder)
            if study.figures or study.tables or study.report:  # else it is being computed
                found[folder.name] = study
    order = {name: i for i, name in enumerate(STUDIES)}
    names = sorted(found, reverse=True)  # of later steps first
    names.sort(key=lambda name: order.get(name, len(order)))
    return [found[name] for name in names]


def report(name: str, *places: Path) -> Path | None:
    """The report of the study `name`; None if there is no such study."""
    return next((study.report for study in listing(*places) if study.name == name), None)


def _files(folder: Path, kind: Callable[[Path], bool]) -> list[Path]:
    """The entries of that kind by name, without links; none if it cannot be listed."""
    try:
        return [path for path in sorted(folder.iterdir()) if kind(path) and not path.is_symlink()]
    except OSError:
        return []


def _read(folder: Path) -> Study:
    files = _files(folder, Path.is_file)
    try:
        content = read_json(folder / WORDS) if folder / WORDS in files else {}
        words = {
            "claim": str(content["claim"]),
            "findings": tuple(map(str, content["found"])),
            "origin": {str(name): str(value) for name, value in content["origin"].items()},
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError, UserError):
        words = dict[str, Any]()
    size = {path: path.stat().st_size for path in files if path.suffix == ".csv"}
    tables = sorted(filter(size.get, size), key=lambda path: (path.stem != "summary", size[path]))
    figures = tuple(path for path in files if path.suffix == ".png")
    report = folder / REPORT if folder / REPORT in files else None
    return Study(folder.name, figures, tuple(tables), report, **words)
