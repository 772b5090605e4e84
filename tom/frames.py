"""Runs and weighings as pandas frames: `tom.load`, `tom.weigh` (docs/notebook.ipynb)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.analysis.imagine import stored_model
from tom.analysis.ordered_data import OrderedData, find_run, to_env_units
from tom.analysis.planes import row_table, transition_table
from tom.analysis.weighing import Weighed, plan_weighing
from tom.data.sampling import bin_means
from tom.data.transitions import Transitions
from tom.data.unpack import DAMAGE
from tom.envs import ROAD, import_task
from tom.errors import UserError, check_known, reason
from tom.exams.diagnostics import errors_of_rows
from tom.learners import WEIGHED_FIRST
from tom.policy.stored import distances, read_policy
from tom.record import RunReader, Store, layout
from tom.record.decode import read_table
from tom.record.export import export_table
from tom.record.task_record import dimension_names, task_of
from tom.reports import weighing_files
from tom.reports.weighing_files import DISTANCE, REPORT, ROWS, WEIGHTS

BINS = 100
SHOWN = ("learner", "seed", "footprint", "footprint_se", "footprint_noise", "ess", "last_two")
"""columns of a weighing's table, chosen from a report's entries"""


@dataclass(frozen=True)
class Run:
    """A recorded run. Unreadable parts are empty and listed in `reader.problems`."""

    reader: RunReader

    @property
    def name(self) -> str:
        return self.reader.run_id

    @property
    def summary(self) -> pd.Series:
        """The run's main settings and its progress."""
        run, status = self.reader, self.reader.status
        entries = {"env": run.env, "learner": run.learner, "seed": run.seed, "state": run.shown}
        entries |= {"env_step": status.env_step, "last_return": status.last_return}
        return pd.Series({**entries, "best_return": status.best_return}, name=run.run_id)

    @cached_property
    def metrics(self) -> pd.DataFrame:
        """All metrics (`tom.metrics`), one row per recorded `env_step`, NaN if missing."""
        return self.reader.metrics().set_index("env_step")

    @cached_property
    def profiles(self) -> pd.DataFrame:
        """The mean weight of each bin, oldest first, one row per model fit, by `env_step`."""
        recorded = self.reader.profiles()
        return pd.DataFrame(recorded.bins, index=pd.Index(recorded.env_step, name="env_step"))

    @cached_property
    def transitions(self) -> pd.DataFrame:
        """The replay buffer, one row per transition, oldest first.

        As agents see it (`tom.envs`); of a loop of your own in the task's own units.
        """
        rows = self.reader.buffer()[0]
        own = self.reader.own_loop and len(rows)
        return transition_table(to_env_units(self.reader, rows) if own else rows)

    @cached_property
    def live(self) -> dict[str, "Run"]:
        """This run with the live weights of its buffer (`tom.weigh_live`), by learner."""
        return {learner: Run(live) for learner, live in self.reader.live().items()}

    def weights(self, step: int | None = None) -> pd.DataFrame:
        """All weights of the fit at `step` (default: the last stored one), one row per transition.

        Raises UserError if the weights of that fit were not stored.
        """
        return self.reader.snapshot(self.fit(step))

    def rows(self, step: int | None = None) -> pd.DataFrame:
        """The buffer of the fit at `step` (default: the last stored one): `row_table`'s columns.

        Further columns, where they are known: `policy_distance` from each action to the mean action
        of the fit's policy, `error`, that of the run's last model, and the weights of other
        learners for these rows, as `tom.weigh` names them. Raises UserError as `weights`, and if
        the buffer is not kept.
        """
        step = self.fit(step)
        weight = self.reader.snapshot(step)["weight"].to_numpy(np.float32)
        record = self.reader.buffer()[0]
        end = self.reader.profiles().rows_at(step)
        if not len(weight) <= end <= len(record):
            raise UserError(
                f"run {self.name} does not keep its buffer of step {step}"
                + "".join(f"; {problem}" for problem in self.reader.problems)
            )
        rows = record[end - len(weight) : end]
        names = dimension_names(self.reader.env, rows, _obs_names(self.reader))
        more: dict[str, NDArray] = {}
        if self.reader.has_policy(step):
            policy = read_policy(self.reader.path / layout.policy(step))
            more[DISTANCE] = distances(policy.mean, rows.torch())
        more |= _errors(self.reader, rows)
        for path in weighing_files.of_run(self.reader.home.parent, self.name):
            made = read_weighing(path)
            same = (made.report["rows"], made.report["end"]) == (len(weight), end)
            if same and not weighing_files.is_brush(made.report):
                more |= {name: made.weights[name].to_numpy() for name in map(str, made.weights)}
        return row_table(record, weight, end, names, more)

    def fit(self, step: int | None = None) -> int:
        """The step of a fit whose weights are stored, by default the last. Raises UserError."""
        kept = self.reader.snapshot_steps()
        if not kept:
            raise UserError(f"run {self.name} keeps the weights of no fit: name another run")
        if step is not None and step not in kept:
            steps = ", ".join(map(str, kept))
            raise UserError(f"run {self.name} kept no weights of step {step}: it kept {steps}")
        return kept[-1] if step is None else step

    def _repr_html_(self) -> str:
        return self.summary.to_frame().T.to_html()


@dataclass(frozen=True)
class Weighing:
    """The result of `tom weigh`: learners' weights for the same rows, given a policy."""

    report: Mapping[str, Any]
    weights: pd.DataFrame
    """one column `<learner>-s<seed>` each, one row per transition, oldest first, mean 1"""
    recorded: Transitions | None
    """the weighed rows, numpy arrays; None if they are not stored"""
    obs_names: tuple[str, ...] = ()
    """of the task's O dimensions; empty if not known"""
    policy_distance: NDArray[np.float32] | None = field(default=None, repr=False)
    """of each row's action to the policy's mean action; None if it is not stored"""
    run: RunReader | None = field(default=None, repr=False)
    """whose buffer was weighed; None for other data"""
    _made: tuple[OrderedData, list[Weighed]] | None = field(default=None, repr=False)

    @property
    def table(self) -> pd.DataFrame:
        """One row per learner and seed: match to the policy, effective sample size, or NaN."""
        results = pd.DataFrame(self.report["results"])
        table = results.loc[:, [name for name in SHOWN if name in results]]
        return table.astype(dict.fromkeys(table.columns[2:], float))

    @property
    def profiles(self) -> pd.DataFrame:
        """The mean weight in each of 100 equal parts of the data, oldest first, one column each."""
        return pd.DataFrame(
            {
                name: bin_means(self.weights[name].to_numpy(copy=True), BINS).numpy()
                for name in self.weights
            }
        )

    @property
    def notices(self) -> list[str]:
        """What to know before trusting the weights, as `tom weigh` prints it; mostly empty."""
        return weighing_files.notices(self.report)

    @property
    def card(self) -> Mapping[str, Any]:
        """The facts of the data, the policy and the task, and what contradicts itself."""
        return self.report.get("card", {})

    @property
    def random_share(self) -> float:
        """The share of the rows, starting with the oldest, that is random data."""
        return self.report["ordered_from"] / max(self.report["rows"], 1)

    @cached_property
    def transitions(self) -> pd.DataFrame:
        """The weighed rows. Raises UserError if they are not stored."""
        return transition_table(self._recorded())

    def rows(self, of: str | None = None) -> pd.DataFrame:
        """The weighed rows: `row_table`'s columns, then those of `weights`.

        Between them, where they are known, are `policy_distance` from each action to the mean
        action of the weighing's policy, and `error`, that of the run's last model. `weight`, and
        with it the contrast plane, is the column `of`, by default the first one.
        Raises UserError if the rows are not stored, or there is no such column.
        """
        of = str(self.weights.columns[0]) if of is None else of
        check_known("column", [of], list(map(str, self.weights)))
        rows = self._recorded()
        record, end = rows, len(rows)
        if self.run is not None:
            record, end = self.run.buffer()[0], self.report["end"]
        names = dimension_names(str(self.report["env"]), rows, self.obs_names)
        weights = {str(name): self.weights[name].to_numpy() for name in self.weights}
        known = {} if self.policy_distance is None else {DISTANCE: self.policy_distance}
        more = known | ({} if self.run is None else _errors(self.run, rows)) | weights
        return row_table(record, weights[of], end, names, more)

    def _recorded(self) -> Transitions:
        if self.recorded is None:
            raise UserError(f"the rows of {self.report['data']} are not kept here: load its run")
        return self.recorded

    def by_learner(self) -> dict[str, NDArray[np.float64]]:
        """The profiles of each learner's seeds, (S, 100)."""
        profiles = self.profiles
        grouped: dict[str, list[NDArray[np.float64]]] = {}
        for name in profiles:
            grouped.setdefault(str(name).rpartition("-s")[0], []).append(profiles[name].to_numpy())
        return {learner: np.stack(seeds) for learner, seeds in grouped.items()}

    def save(self, out: Path | str) -> Path:
        """Write the weighing into the new folder `out`, like `tom weigh`. Raises UserError."""
        if self._made is None:
            raise UserError("this weighing was loaded from a folder: copy that folder")
        weighing_files.check_free(Path(out))
        weighing_files.write(Path(out), *self._made, BINS, dict(self.report))
        return Path(out)

    def _repr_html_(self) -> str:
        return self.table.to_html(index=False)


def load(name: str | Path, store: str | Path = "runs") -> Run | Weighing:
    """Load a run (id or folder) or the folder of a weighing. Raises UserError if it is neither."""
    place = Store(Path(store))
    kept = [path for path in weighing_files.folders(place.path) if path.name == str(name)]
    for path in (Path(name), *kept):
        if (path / REPORT).is_file():
            return read_weighing(path)
    run = find_run(str(name), place)
    if run is None or not run.is_run:
        raise UserError(
            f"no run or weighing '{name}': name a folder, or a run of {place.path}/ (`tom runs`)"
        )
    return Run(run)


def export_rows(name: str, store: Path, step: int | None, folder: Path) -> Path:
    """Write the rows of a run's fit at `step` [the last kept], or of a weighing, as Parquet.

    Raises UserError if there is no such fit, or the file exists already.
    """
    made = load(name, store)
    if isinstance(made, Run):
        step = made.fit(step)
        return export_table(made.rows(step), folder / f"{made.name}-rows-{step}.parquet")
    if step is not None:
        raise UserError(f"{name} is a weighing, which has one buffer: --rows without a step")
    return export_table(made.rows(), folder / f"{Path(name).name}-rows.parquet")


def weigh(
    data: str | Path,
    policy: str | Path,
    *,
    env: str | None = None,
    learners: Sequence[str] = WEIGHED_FIRST,
    seeds: Sequence[int] = (0, 1, 2),
    footprint: int = 1000,
    step: int | None = None,
    collected_by: Sequence[str] = (),
    preset: str | None = None,
    settings: Mapping[str, Any] | None = None,
    store: str | Path = "runs",
    stepped: Callable[[], None] = lambda: None,
) -> Weighing:
    """Compute each learner's weights for recorded `data`, given the policy of interest `policy`.

    The arguments are those of `tom weigh`; `settings` are nested like a run's, for example
    `{"tom": {"q_steps": 500}}`. Nothing is written before `save`. `stepped` is called after each
    step of the policy in the task. Raises UserError, or ValidationError for a wrong setting.
    """
    begun = perf_counter()
    import_task(env)
    plan = plan_weighing(
        str(data), str(policy), Store(Path(store)), env=env, step=step, preset=preset,
        collected_by=collected_by, settings=settings or {}, learners=learners, seeds=seeds,
        footprint=footprint,
    )  # fmt: skip
    weighed = list(plan.carry_out(stepped))
    command, hours = f"tom.weigh({str(data)!r}, {str(policy)!r})", (perf_counter() - begun) / 3600
    report = weighing_files.report(plan, weighed, str(policy), step, command, hours)
    weights = pd.DataFrame({f"{one.learner}-s{one.seed}": one.weights for one in weighed})
    rows = plan.data.transitions.numpy()
    return Weighing(
        report, weights, rows, plan.known.obs_names, plan.data.policy_distance,
        plan.data.run, (plan.data, weighed),
    )  # fmt: skip


def read_weighing(path: Path) -> Weighing:
    """The weighing, or the brush, in a folder. Raises UserError."""
    try:
        report, weights = weighing_files.read_report(path), read_table(path / WEIGHTS)
    except DAMAGE as error:
        raise UserError(f"weighing {path} cannot be read ({reason(error)}): weigh again") from error
    kept = [name for name in weights if str(name).rpartition("-s")[2].isdigit()]
    distance = weights[DISTANCE].to_numpy() if DISTANCE in weights else None
    in_folder, store = ROWS in report, path.absolute().parent
    run = RunReader(path) if in_folder else None
    if run is None and store.name == layout.WEIGHINGS:
        run = find_run(str(report["data"]), Store(store.parent))
    if run is None:
        return Weighing(report, weights.loc[:, kept], None, (), distance)
    recorded = run.buffer()[0].numpy()
    end = report["end"]
    rows = recorded[end - len(weights) : end] if len(weights) <= end <= len(recorded) else None
    of = None if in_folder else run
    return Weighing(report, weights.loc[:, kept], rows, _obs_names(run), distance, of)


def _errors(run: RunReader, rows: Transitions) -> dict[str, NDArray]:
    """The one-step errors (N,) of the run's last model, if it kept one."""
    try:
        return {"error": errors_of_rows(stored_model(run).predictor, rows.torch()).numpy()}
    except UserError:
        return {}


def _obs_names(run: RunReader) -> tuple[str, ...]:
    return () if run.env == ROAD else task_of(run).obs_names
