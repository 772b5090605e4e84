"""The run store: a folder of run folders."""

import os
from datetime import datetime
from pathlib import Path

from tom.errors import UserError
from tom.record import layout
from tom.record.files import free_name
from tom.record.reader import RunReader


class Store:
    """The runs in a folder. Reading never creates or changes anything."""

    def __init__(self, path: Path | str = "runs") -> None:
        self.path = Path(path)
        self.problems: list[str] = []

    def runs(self) -> list[RunReader]:
        """Every readable run, newest first.

        Folders that are not runs are left out and listed in `problems`. Raises UserError if the
        store itself cannot be read; a store that does not exist yet is empty.
        """
        self.problems = []
        readers = []
        for name in self.names():
            try:
                readers.append(self.open_run(name))
            except UserError as error:
                self.problems.append(str(error))
        return sorted(readers, key=lambda run: (run.created, run.run_id), reverse=True)

    def names(self) -> list[str]:
        """The folders that may be runs, and links that stand where `beside` looks.

        Raises UserError if the store cannot be read.
        """
        try:
            with os.scandir(self.path) as entries:
                folders = sorted(entry.name for entry in entries if entry.is_dir())
        except FileNotFoundError:
            return []
        except OSError as error:
            raise UserError(
                f"cannot read the store {self.path}: {error.strerror}; name another with --store"
            ) from error
        names = [name for name in folders if name not in layout.BESIDE_RUNS and name[0] != "."]
        return [*names, *(n for n in layout.BESIDE_RUNS if (self.path / n).is_symlink())]

    def open_run(self, name: str) -> RunReader:
        """The run in the folder `name`. Raises UserError with the reason if it is not a run."""
        reader = RunReader(self.resolve(name))
        if not reader.is_run:
            why = "; ".join(reader.problems) or "its config.json is not a run's"
            raise UserError(f"{name}: not a run ({why})")
        return reader

    def run(self, run_id: str) -> RunReader:
        """The run `run_id`. Raises UserError if there is none."""
        if not self.resolve(run_id).is_dir():
            newest = ", ".join(run.run_id for run in self.runs()[:3]) or "none"
            raise UserError(f"no run '{run_id}' in {self.path}/ (newest: {newest}; see `tom runs`)")
        return self.open_run(run_id)

    def resolve(self, run_id: str) -> Path:
        """The folder of `run_id`, which need not exist.

        Raises UserError for an invalid id, or one that leads out of the store.
        """
        if run_id in layout.BESIDE_RUNS:
            self.beside(run_id)
            raise UserError(f"'{run_id}' is no run id: that folder of a store is for other things")
        if not layout.RUN_ID.fullmatch(run_id):
            raise UserError(
                f"'{run_id[:120]}' is no run id: use letters, digits, '.', '_' and '-', "
                "at most 100, starting with a letter or digit"
            )
        return self.beside(run_id)

    def beside(self, name: str) -> Path:
        """The folder `name` of the store, as of layout.BESIDE_RUNS, which need not exist.

        Raises UserError if it is a link.
        """
        folder = self.path / name
        if folder.is_symlink():
            raise UserError(f"{folder} is a link: not followed; move it away")
        return folder

    def new_run_id(self, env: str, learner: str, seed: int) -> str:
        """A free run id: `<env>-<learner>-s<seed>-<yymmdd-hhmmss>`, with a number if taken."""
        now = f"{datetime.now():%y%m%d-%H%M%S}"
        return free_name(self.path, layout.run_name(env, learner, seed, now))

    def new_weighing(self, name: str) -> Path:
        """A free folder for a new weighing of that name, with date, and a number if taken."""
        folder, named = self.beside(layout.WEIGHINGS), name.lstrip(".") or "data"
        return folder / free_name(folder, f"{named}-{datetime.now():%y%m%d-%H%M%S}")

    def ensure_there(self) -> None:
        """Raises UserError if there is no such folder: a mistyped name is not an empty store."""
        if not self.path.exists():
            raise UserError(
                f"there is no store {self.path}/: name another with --store, or train something "
                "(`tom demo`)"
            )
