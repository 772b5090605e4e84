"""The run store: a folder of run folders."""

import os
import time
from datetime import datetime
from pathlib import Path

from tom.errors import UserError
from tom.record import layout
from tom.record.files import modified
from tom.record.reader import RunReader


class Store:
    """The runs in a folder. Looking never creates or changes anything."""

    def __init__(self, path: Path | str = "runs") -> None:
        self.path = Path(path)
        self.problems: list[str] = []

    def runs(self) -> list[RunReader]:
        """Every run that can be read, newest first.

        What is no run is named in `problems` and left out. Raises UserError when the store
        itself cannot be read; a store that is not there yet is empty.
        """
        self.problems = []
        readers = []
        for name in self.names():
            try:
                readers.append(self.look(name))
            except UserError as error:
                self.problems.append(str(error))
        return sorted(readers, key=lambda run: (run.created, run.run_id), reverse=True)

    def names(self) -> list[str]:
        """The folders that may be runs. Raises UserError when the store cannot be read."""
        return [n for n in self._names() if n != layout.WEIGHINGS and not n.startswith(".")]

    def look(self, name: str) -> RunReader:
        """The run in the folder `name`. Raises UserError, saying why, when it is not a run."""
        reader = RunReader(self.resolve(name))
        if not reader.is_run:
            raise UserError(f"{name}: no run ({_why(reader)})")
        return reader

    def recent(self, seconds: float) -> list[str]:
        """Ids of the runs whose status was written within the last `seconds`; one stat a run."""
        since = time.time() - seconds
        names = [name for name in self._names() if layout.RUN_ID.fullmatch(name)]
        return [n for n in names if modified(self.path / n / layout.STATUS) >= since * 1e9]

    def run(self, run_id: str) -> RunReader:
        """The run called `run_id`. Raises UserError when there is none."""
        path = self.resolve(run_id)
        if not path.is_dir():
            newest = ", ".join(run.run_id for run in self.runs()[:3]) or "none"
            raise UserError(f"no run '{run_id}' in {self.path}/ (newest: {newest}; see `tom runs`)")
        reader = RunReader(path)
        if not reader.is_run:
            raise UserError(f"'{run_id}' in {self.path}/ is no run: {_why(reader)}")
        return reader

    def resolve(self, run_id: str) -> Path:
        """The folder of `run_id`, which need not exist.

        Raises UserError for an id that is not one, or that leads out of the store.
        """
        if not layout.RUN_ID.fullmatch(run_id):
            raise UserError(
                f"'{run_id[:120]}' is no run id: use letters, digits, '.', '_' and '-', "
                "at most 100, starting with a letter or digit"
            )
        if run_id == layout.WEIGHINGS:
            raise UserError(f"'{run_id}' is no run id: weighings lie there; choose another name")
        path = self.path / run_id
        if path.is_symlink():
            raise UserError(
                f"run '{run_id}' is a link, which {self.path}/ may not hold: not followed"
            )
        return path

    def new_run_id(self, env: str, learner: str, seed: int) -> str:
        """A free run id: `<env>-<learner>-s<seed>-<yymmdd-hhmmss>`, numbered when taken."""
        base = f"{env}-{learner}-s{seed}-{datetime.now():%y%m%d-%H%M%S}"
        run_id, number = base, 1
        while os.path.lexists(self.path / run_id):
            number += 1
            run_id = f"{base}-{number}"
        return run_id

    def ensure_there(self) -> None:
        """Raises UserError where there is no such folder: a mistyped name is no empty store."""
        if not self.path.exists():
            raise UserError(
                f"there is no store {self.path}/: name another with --store, or train something "
                "(`tom demo`)"
            )

    def ensure_writable(self) -> None:
        """Make the store's folder. Raises UserError when nothing can be written there."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(
                f"cannot make the store {self.path}: {error.strerror}; name another with --store"
            ) from error
        if not os.access(self.path, os.W_OK | os.X_OK):
            raise UserError(f"cannot write to the store {self.path}: name another with --store")

    def _names(self) -> list[str]:
        try:
            return sorted(entry.name for entry in os.scandir(self.path) if entry.is_dir())
        except FileNotFoundError:
            return []
        except OSError as error:
            raise UserError(
                f"cannot read the store {self.path}: {error.strerror}; name another with --store"
            ) from error


def _why(reader: RunReader) -> str:
    return "; ".join(reader.problems) or "its config.json is not a run's"
