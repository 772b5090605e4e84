"""Read a run folder (docs/run-folder.md), also if it is live, killed, newer or damaged.

Unreadable parts are left out and listed in `problems`; bad content never raises an error.
"""

import os
from collections.abc import Callable, Sequence
from copy import copy
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.config import SAC_ALONE
from tom.data.transitions import BEHAVIOUR, Transitions
from tom.data.unpack import DAMAGE, cannot_read_now, read_arrays
from tom.errors import reason
from tom.events import Episode
from tom.readable import Settings, in_words
from tom.record import checkpoint, decode, layout
from tom.record.decode import Profiles, read_table
from tom.record.files import MISSING, modified, read_json, read_json_lines, stamp
from tom.record.status import Labels, Status, labels_of, status_of

T = TypeVar("T")

THINNED = "thinned"
"""what the `config.json` of a small copy (`thin`) has in addition"""
SMALL_COPY = "a small copy"

Part = Literal[
    "facts", "metrics", "profiles", "notices", "snapshot", "episodes", "pictures", "policies",
    "buffer", "model", "scene", "recordings",
]  # fmt: skip
"""what `RunReader.version` tells versions of; facts are configuration, status and labels"""
FILES: dict[str, tuple[str, ...]] = {
    "facts": (layout.CONFIG, layout.STATUS, layout.LABELS),
    "metrics": (layout.METRICS, layout.METRICS_TABLE, layout.METRICS + layout.PACKED),
    "profiles": (layout.PROFILES, layout.PROFILES + layout.PACKED),
    "notices": (layout.NOTICES,),
    "scene": (layout.SCENE,),
    "recordings": ("",),  # the folder itself, which every page needs for every run
}
"""the files of those parts whose names are fixed"""
OF_LOOP = ("buffer", "episodes")
"""the parts, and folders, that live weights share with their loop"""
Version = tuple[tuple[int, int], ...]
"""(mtime_ns, size) of each file"""


class Recorded(NamedTuple):
    """The replay buffer in order of collection; all are numpy arrays."""

    rows: Transitions
    version: NDArray[np.int64]
    """(N,) the policy that collected each row; 0 is exploration"""
    state: dict[str, NDArray]
    """the simulator's `qpos` (N, nq) and `qvel` (N, nv) at each row; empty if not stored"""
    behaviour: NDArray[np.float32]
    """(N, 2 A) the Gaussian of each action (`ReplayBuffer.behaviour`); NaN if not stored"""


def at_or_before(steps: Sequence[int], step: int) -> int:
    """The last of `steps` that is not after `step`, else the first one."""
    return max((at for at in steps if at <= step), default=steps[0])


class RunReader:
    """One run folder. Cheap to make.

    What identifies the run, its status and its labels are read once, when they are first asked for;
    every method reads the current files.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.problems: list[str] = []
        self.unread: list[str] = []
        """problems of files that cannot be read for now: nothing is known of their content"""

    @cached_property
    def home(self) -> Path:
        """The folder of the run in its store: `path`, but of live weights that of their loop."""
        if self.path.parent.name == layout.LIVE and (self.path.parents[1] / layout.CONFIG).exists():
            return self.path.parents[1]
        return self.path

    @property
    def run_id(self) -> str:
        return self.home.name

    @property
    def argument(self) -> str:
        """What commands call the run: its id, but of live weights their folder."""
        return self.run_id if self.home == self.path else str(self.path)

    @property
    def name(self) -> str:
        """The user's name of the run, else its id."""
        return self.labels.name or self.run_id

    @cached_property
    def config(self) -> dict[str, Any]:
        """The whole of `config.json`; empty if it cannot be read."""
        content = self._read(layout.CONFIG, read_json, needed=True)
        if content is None:
            return {}
        if isinstance(schema := content.get("schema"), int) and schema > layout.SCHEMA:
            self._problem(
                f"written by a newer version (schema {schema}, this one knows {layout.SCHEMA}): "
                "parts may be missing; update tom-studio"
            )
        return content

    @property
    def given(self) -> dict[str, Any]:
        """The settings in `config.json`; empty if it has none."""
        settings = self.config.get("config")
        return settings if isinstance(settings, dict) else {}

    @property
    def is_run(self) -> bool:
        """Whether `config.json` exists and is that of a run."""
        kinds = {"schema": int, "env": str, "learner": str}
        return all(isinstance(self.config.get(name), kind) for name, kind in kinds.items())

    @property
    def env(self) -> str:
        return str(self.config.get("env", "?"))

    @property
    def learner(self) -> str:
        return str(self.config.get("learner", "?"))

    @property
    def preset(self) -> str:
        return str(self.config.get("preset", "?"))

    @cached_property
    def settings(self) -> Settings:
        """The whole configuration by dotted path, values as text."""
        return in_words(self.config.get("config"))

    @property
    def fits_model(self) -> bool:
        """False for a recording of SAC alone."""
        return self.learner != SAC_ALONE

    @property
    def own_loop(self) -> bool:
        """Whether it is of a training loop of the user's own, which nothing here can resume."""
        return "own" in self.given

    def live(self) -> dict[str, "RunReader"]:
        """The live weights of its buffer (`tom.weigh_live`) by learner.

        Each is this run seen with those weights: rows, labels and replays are the run's.
        """
        found = map(RunReader, sorted((self.path / layout.LIVE).glob("*/")))
        return {one.learner: one for one in found if one.is_run}

    @property
    def seed(self) -> int:
        return self.config.get("seed", 0)

    @property
    def created(self) -> str:
        """When the run was created, ISO 8601; empty when unknown."""
        return str(self.config.get("created", ""))

    @property
    def small_copy(self) -> bool:
        """Whether it is a small copy (`tom runs export --small`), which cannot be resumed."""
        return THINNED in self.config

    @property
    def left_out(self) -> tuple[str, ...]:
        """The parts of the run that this small copy lacks (of `other ...` it has some)."""
        return tuple(self.config.get(THINNED, {}).get("left_out", ()))

    @property
    def shown(self) -> str:
        """The state in words: `finished`, or `finished (a small copy)`."""
        return f"{self.status.shown} ({SMALL_COPY})" if self.small_copy else self.status.shown

    @cached_property
    def status(self) -> Status:
        return self._read(layout.STATUS, lambda p: status_of(read_json(p)), needed=True) or Status()

    def with_status(self, status: Status) -> "RunReader":
        """This run for readers who know more of its status than its file says."""
        run = copy(self)
        run.status = status
        return run

    @cached_property
    def labels(self) -> Labels:
        return self._read(layout.LABELS, lambda p: labels_of(read_json(p))) or Labels()

    def metrics(self) -> pd.DataFrame:
        """One row per recorded step: `env_step` and every metric (NaN if missing).

        The Parquet copy is used unless the run has been resumed since it was written.
        """
        rows, table = self.path / layout.METRICS, self.path / layout.METRICS_TABLE
        if modified(table) >= modified(rows) > 0:
            read = self._read(layout.METRICS_TABLE, read_table)
            if read is not None and "env_step" in read:
                return read
        return self.metric_rows()

    def metric_rows(self) -> pd.DataFrame:
        """`metrics` of the rows themselves, whatever the Parquet copy says."""
        return self._rows(layout.METRICS, decode.metrics_table)

    def profiles(self) -> Profiles:
        return self._rows(layout.PROFILES, decode.profiles_of)

    def notices(self) -> list[dict[str, Any]]:
        """The notices, with `env_step`, `code` and `message`."""
        return self._rows(layout.NOTICES, list)

    def snapshot_steps(self) -> list[int]:
        """Steps of the model fits whose single weights were stored."""
        return layout.numbers(self.path / "weights", ".parquet", "snapshot")

    def snapshot(self, step: int) -> pd.DataFrame:
        """One row per transition, oldest first: `weight`, and if stored `log_ratio`, `dim_i`."""
        read = self._read(layout.snapshot(step), read_table, needed=True)
        return pd.DataFrame({"weight": np.zeros(0, np.float32)}) if read is None else read

    def policy_steps(self) -> list[int]:
        """Steps of the model fits whose policy of interest was stored."""
        return layout.numbers(self.path / layout.POLICIES, ".npz")

    def has_policy(self, step: int | None = None) -> bool:
        """Whether the policy of interest of the fit at `step` was stored (None: the final one).

        Only a finished run has a final one: if it was given more steps, its file is of earlier.
        """
        if step is None:
            return self.status.state == "finished" and self.version("policies")[1] != MISSING
        return self.version("policies", step)[0] != MISSING

    def keeps_behaviour(self) -> bool:
        """Whether the run says which policies drew its actions (`Recorded.behaviour`).

        Reads the names of the first segment's arrays: an older run that was resumed does not.
        """
        return bool(self._read(layout.segment(0), lambda p: read_arrays(p, BEHAVIOUR.__contains__)))

    def evaluation_steps(self) -> list[int]:
        return layout.numbers(self.home / "episodes", ".npz")

    def episodes(self, step: int) -> list[Episode]:
        name = layout.episodes(step)
        read = self._read(name, lambda p: decode.episodes_of(read_arrays(p)), needed=True)
        return read or []

    def buffer(self) -> tuple[Transitions, NDArray[np.int64]]:
        """The rows and policy versions of `recorded`, without the memory for the states."""
        return self.recorded(states=False)[:2]

    def recorded(self, *, states: bool = True, behaviour: bool = True) -> Recorded:
        """The replay buffer; what is not asked for is not read, and empty.

        Reading ends at the first missing or damaged segment, so that the rows stay aligned with the
        weights.
        """
        parts: list[Recorded] = []

        def wanted(name: str) -> bool:
            return behaviour if name in BEHAVIOUR else states or not name.startswith(decode.STATE)

        def segment(path: Path) -> Recorded:
            arrays = read_arrays(path, wanted)
            rows, version = decode.transitions_of(arrays)
            named = [name for name in arrays if name.startswith(decode.STATE)]
            state = {name.removeprefix(decode.STATE): arrays[name] for name in named}
            unknown = np.full((len(rows), rows.action.shape[1] * behaviour), np.nan, np.float32)
            drawn = [arrays.get(name, unknown) for name in BEHAVIOUR]
            return Recorded(rows, version, state, np.concatenate(drawn, 1, dtype=np.float32))

        self._read(layout.BUFFER, os.listdir)  # a folder that cannot be listed is no empty one
        row = 0
        for first in layout.numbers(self.home / layout.BUFFER, ".npz"):
            name = layout.segment(first)
            if first != row:
                self._problem(f"{name}: rows {row} to {first} are missing; later rows are left out")
                break
            part = self._read(name, segment)
            if part is None:
                break
            parts.append(part)
            row += len(part.rows)
        if not parts:
            flat, wide = np.zeros(0, np.float32), np.zeros((0, 0), np.float32)
            rows = Transitions(wide, wide, flat, wide, flat.astype(bool), flat.astype(bool))
            return Recorded(rows, flat.astype(np.int64), {}, wide)
        rows, version, state, drawn = zip(*parts, strict=True)
        kept = set(state[0]).intersection(*state)
        return Recorded(
            Transitions.concatenate(rows),
            np.concatenate(version),
            {name: np.concatenate([part[name] for part in state]) for name in sorted(kept)},
            np.concatenate(drawn),
        )

    def buffer_length(self) -> int:
        """The number of rows ever collected; reads only the end of the last segment."""
        first = max(layout.numbers(self.home / layout.BUFFER, ".npz"), default=0)
        last = self.arrays(layout.segment(first), lambda name: name == "reward") or {}
        return first + len(last["reward"]) if "reward" in last else 0

    def buffer_bytes(self) -> int:
        """The bytes of the buffer's files. Reads no file."""
        firsts = layout.numbers(self.home / layout.BUFFER, ".npz")
        return sum(stamp(self.home / layout.segment(first))[1] for first in firsts)

    def field_names(self) -> list[str]:
        """The names of the task's own pictures."""
        return layout.names(self.path / "fields", ".npz")

    def field_steps(self, name: str) -> list[int]:
        return layout.numbers(self.path / "fields", ".npz", name)

    def field(self, name: str, step: int) -> dict[str, NDArray]:
        """The arrays of the task's own picture `name` at `step`."""
        return self.arrays(layout.field(name, step)) or {}

    def arrays(
        self, name: str, wanted: Callable[[str], bool] = lambda name: True
    ) -> dict[str, NDArray] | None:
        """The `wanted` arrays of the run's file `name`; None if it cannot be read."""
        return self._read(name, lambda p: read_arrays(p, wanted), needed=True)

    def list_folders(self) -> None:
        """Name folders that cannot be listed among `problems`: they look as if they were empty."""
        for name in layout.FOLDERS:
            self._read(name, os.listdir)

    def rrd_files(self) -> list[Path]:
        return layout.rrd_files(self.path)

    def version(self, part: Part, step: int = 0) -> Version:
        """A value that changes whenever the files of a part (at `step`) change. Reads no file.

        A cache stores data read from a run together with it (`app/data/cache.py`).
        """
        names: Sequence[str] = FILES.get(part, ())
        match part:
            case "snapshot":
                names = (layout.snapshot(step),)
            case "episodes":
                names = (layout.episodes(step),)
            case "pictures":
                names = [layout.field(name, step) for name in self.field_names()]
            case "policies":
                names = layout.policy(step), layout.POLICY
            case "buffer":  # the last segment, the only one that changes
                firsts = layout.numbers(self.home / layout.BUFFER, ".npz")
                names = [layout.segment(first) for first in firsts[-1:]]
            case "model":
                places = [self.path / place for place in checkpoint.MODEL_PLACES]
                found = [path for place in places for path in checkpoint.folders(place)]
                states = [str((path / checkpoint.STATE).relative_to(self.path)) for path in found]
                names = [layout.CONFIG, *states]
        folder = str(self.home if part in OF_LOOP else self.path)
        return tuple(stamp(f"{folder}/{name}") for name in names)

    def _rows(self, name: str, decoded: Callable[[list[dict[str, Any]]], T]) -> T:
        def lines(path: Path) -> T:
            rows, problems = read_json_lines(path)
            for problem in problems:
                self._problem(problem)
            return decoded(rows)

        read = self._read(name, lines)
        return decoded([]) if read is None else read

    def _read(self, name: str, read: Callable[[Path], T], *, needed: bool = False) -> T | None:
        of_loop = name == layout.LABELS or name.partition("/")[0] in OF_LOOP
        try:
            return read((self.home if of_loop else self.path) / name)
        except FileNotFoundError:
            if needed:
                self._problem(f"{name} is missing")
        except DAMAGE as error:
            problem = f"{name} cannot be read: {reason(error)}"
            self._problem(problem)
            if cannot_read_now(error):
                self.unread.append(problem)
        return None

    def _problem(self, text: str) -> None:
        if text not in self.problems:
            self.problems.append(text)
