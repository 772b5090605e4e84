"""What other trackers recorded, as runs of their own: metrics alone, for Curves.

TensorBoard's event files and the CSV that Weights & Biases exports. Both are read as numbers only.
"""

import re
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from tom.config import OwnLoopConfig
from tom.errors import UserError, reason
from tom.events import Metrics, Tick
from tom.own_loop.opening import open_record, resolve_task
from tom.record import Store

RETURNS = (
    "eval/return",
    "eval/mean_reward",
    "eval/episode_reward",
    "evaluation/return",
    "charts/episodic_return",
    "rollout/ep_rew_mean",
    "train/return",
)
"""metrics that become the return, the first that is there"""
STEPS = ("global_step", "env_step", "Step", "_step", "step")
"""columns of a CSV that count env steps, the first that is there; W&B's own count its logs"""


def import_metrics(
    path: str | Path,
    env: str,
    store: str | Path = "runs",
    name: str = "",
    returned: str = "",
) -> list[str]:
    """Make a run of each training in `path`; their ids.

    `path` is an event file of TensorBoard, a folder with some of one training, or W&B's CSV, which
    may have several trainings, `RUN - METRIC`. `env` is the task, as in `tom.record`; `name` that
    of the run, by default the file's; `returned` is the metric that is the return [the first of
    RETURNS]. Steps are taken to be env steps. Raises UserError.
    """
    path = Path(path).absolute()  # `.` has no name
    try:
        found = _csv(path) if path.suffix == ".csv" else {"": _events(path)}
    except (OSError, ValueError, struct.error) as error:
        raise UserError(f"{path} cannot be read: {reason(error)}") from error
    metrics = dict.fromkeys(metric for table in found.values() for metric in table)
    if not metrics:
        raise UserError(f"{path} holds no scalars: give TensorBoard's events or W&B's CSV")
    if returned and returned not in metrics:
        raise UserError(f"{path} has no metric '{returned}': it has {', '.join(metrics)}")
    named, own = {}, path.name if path.is_dir() else path.stem
    for training, table in found.items():
        words = "-".join(filter(None, (name, training or ("" if name else own))))
        run_id = re.sub(r"[^A-Za-z0-9._-]", "-", words)[:95]
        named[f"{run_id}-{len(named) + 1}" if run_id in named else run_id] = table
    place, known = Store(Path(store)), resolve_task(env)
    if taken := [run_id for run_id in named if place.resolve(run_id).exists()]:
        raise UserError(f"run '{taken[0]}' exists already: choose another --name")
    for run_id, table in named.items():
        last, given = int(table.index[-1]), {"imported": path.name}
        settings = OwnLoopConfig(env=known.name, steps=max(last, 1), own=given)
        chosen = returned or next((metric for metric in RETURNS if metric in table), "")
        with open_record(place, run_id, settings) as recorder:
            # Steps before that of the status have no time: theirs is not known.
            recorder.consume(Tick(last + 1, "import"))
            # A metric of that name that is not the chosen one keeps its numbers under another.
            names = {"eval/return": "imported/eval/return", chosen: "eval/return"}
            for step, values in table.rename(columns=names).iterrows():
                recorder.consume(Metrics(int(str(step)), values.dropna().to_dict()))
            recorder.consume(Tick(last, "import"))
    return list(named)


def _events(path: Path) -> pd.DataFrame:
    """The metrics of event files by step; of several values at one step the last."""
    files = sorted(path.glob("*tfevents*")) if path.is_dir() else [path]
    if not files:
        raise UserError(f"{path} holds no event files of TensorBoard (*tfevents*)")
    rows = [row for file in files for row in _scalars(file.read_bytes())]
    table = pd.DataFrame(rows, columns=["step", "metric", "value"])
    return table.pivot_table("value", "step", "metric", aggfunc="last")


def _scalars(content: bytes) -> Iterable[tuple[int, str, float]]:
    """Step, name and value of each scalar; a record that a kill cut short ends the file."""
    # Imported here because most commands do not need it.
    from google.protobuf.message import DecodeError
    from tensorboardX.proto import event_pb2

    event, at = vars(event_pb2)["Event"], 0
    while at + 12 <= len(content):
        (size,) = struct.unpack_from("<Q", content, at)
        record, at = content[at + 12 : at + 12 + size], at + 16 + size
        if len(record) < size:
            return
        try:
            read = event.FromString(record)
        except DecodeError as error:
            raise ValueError("no event file of TensorBoard") from error
        for value in read.summary.value:
            if value.HasField("simple_value"):
                yield read.step, value.tag, value.simple_value
            elif value.HasField("tensor") and (number := _number(value.tensor)) is not None:
                yield read.step, value.tag, number


def _number(tensor) -> float | None:
    """The value of a scalar tensor of TensorFlow 2; None if it is anything else."""
    stored = [*tensor.float_val, *tensor.double_val]
    kinds = {1: np.float32, 2: np.float64}
    if not stored and tensor.dtype in kinds and not tensor.tensor_shape.dim:
        stored = np.frombuffer(tensor.tensor_content, kinds[tensor.dtype]).tolist()
    return float(stored[0]) if len(stored) == 1 else None


def _csv(path: Path) -> dict[str, pd.DataFrame]:
    """By training the metrics of a table: `Step` and `RUN - METRIC`, or a column a metric."""
    table = pd.read_csv(path)
    step = next((column for column in STEPS if column in table), None)
    if step is None:
        raise UserError(f"{path} has no column of steps: name it one of {', '.join(STEPS)}")
    columns = {name: pd.to_numeric(table[name], errors="coerce") for name in table}
    numbers = pd.DataFrame(columns).dropna(subset=[step])
    found: dict[str, dict[str, pd.Series]] = {}
    for column, values in numbers.astype({step: int}).groupby(step).last().items():
        training, dash, metric = str(column).rpartition(" - ")
        metric = metric if dash else str(column)
        if not metric.endswith(("__MIN", "__MAX")) and values.notna().any():
            found.setdefault(training, {})[metric] = values
    return {name: pd.DataFrame(series).dropna(how="all") for name, series in found.items()}
