"""The map of a buffer: its planes, the weights on it, and which rows a selection chooses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from app.data import buffer, columns, weighings
from app.data.cache import LOCK, cached, publish_array
from app.data.columns import AGE, DISTANCE, ERROR, ERROR_ROWS, RANK, WEIGHT, Column
from app.data.readers import profiles
from app.data.selection import Mask, Selection, between, inside
from app.data.weighings import Dataset, Weighing
from tom.analysis import planes, why
from tom.analysis.brush import UNCHANGED
from tom.analysis.imagine import StoredModel
from tom.analysis.weight_readers import first_weight_reader
from tom.dynamics.neural import NeuralDynamics
from tom.envs import ROAD
from tom.errors import UserError
from tom.learners import learner_label
from tom.machine.memory import STUDIO_CACHE_BYTES
from tom.policy.stored import StoredPolicy
from tom.policy.stored import distances as policy_distances
from tom.record.reader import RunReader
from tom.reports.weighing_files import called, is_brush
from tom.spread import spread

CONTRAST, PRINCIPAL, POLICY, MODEL, TWO = "contrast", "principal", "policy", "model", "two"
WEIGHINGS = 3
"""maximum number of weighings, and of brushes, to choose from, the newest"""
SAMPLED_ROWS = 50_000
"""maximum number of rows from which the share that a plane explains is computed"""
NEAREST = 10
_LAST_PLANES: LRUCache[tuple[Path, str], planes.Plane] = LRUCache(1000)
"""planes by run and key: an outline stays when a training has replaced the fit of its plane"""


@dataclass(frozen=True)
class Source:
    """Weights (N,) of the N recorded rows before row `end`: a fit's, or a column of a weighing."""

    label: str
    weight: NDArray[np.float32]
    step: int | None  # of that buffer; None: of all rows that there were
    end: int
    version: object
    learner: str
    weighing: Weighing | None = None
    column: str = "weight"

    @property
    def first(self) -> int:
        return self.end - len(self.weight)

    @property
    def option(self) -> str:
        """What `tom brush --weighing` calls these weights; empty for a fit's."""
        return f"{self.weighing.path}:{self.column}" if self.weighing else ""


def fit_sources(run: RunReader) -> dict[str, Source]:
    """The weights of a run's own fits by their step, in order; those it lacks rows of left out."""
    length = buffer.length(run)
    found = {str(step): _fit_source(run, step, length) for step in run.snapshot_steps()}
    return {step: source for step, source in found.items() if source is not None}


def _fit_source(run: RunReader, step: int, length: int) -> Source | None:
    weight = buffer.fit_weight(run, step)
    end = profiles(run).rows_at(step)
    if not 0 < len(weight) <= end <= length:
        return None
    version = run.version("snapshot", step), run.has_policy(step)
    return Source(str(step), weight, step, end, version, run.learner)


def weighing_sources(run: RunReader) -> dict[str, Source]:
    """What `tom weigh` and brushes made of a run's buffer, by label: the newest."""
    length = buffer.length(run)
    made, brushes = (weighings.of_run(run, brush=brush) for brush in (False, True))
    return {
        label: Source(
            label,
            weight,
            weighing.step,
            weighing.end,
            weighing.written,
            learner,
            weighing,
            f"{learner}-s{seed}",
        )
        for weighing in (*made[:WEIGHINGS], *brushes[:WEIGHINGS])
        for (learner, seed), weight in weighing.weights().items()
        if not (is_brush(weighing.report) and learner == called(UNCHANGED))
        and len(weight) <= weighing.end <= length
        for label in [f"{learner_label(learner)} s{seed}, {weighing.name}"]
    }


def sources(run: RunReader) -> dict[str, Source]:
    """All weights of a run's buffer."""
    return ({} if isinstance(run, Dataset) else fit_sources(run)) | weighing_sources(run)


@cached("buffer")
def distances(run: RunReader, source: Source) -> buffer.Floats | None:
    """The distance (N,) of each row's action to the policy of these weights; None if not known."""
    if source.weighing is not None:
        return source.weighing.policy_distance
    policy = buffer.stored_policy(run, source.step)
    rows = buffer.recorded(run).rows[source.first : source.end].torch()
    return None if policy is None else policy_distances(policy.mean, rows).astype(np.float64)


def knows_policy(run: RunReader, source: Source) -> bool:
    """Whether `distances` may be known. Reads no policy of a run."""
    if source.weighing is not None:
        return source.weighing.policy_distance is not None
    return run.env != ROAD and run.has_policy(source.step)


@dataclass(frozen=True)
class RowsOnPlane:
    """A plane and the place of every recorded row on it."""

    names: tuple[str, str]
    xy: NDArray[np.float32]  # (N, 2)
    axes: tuple[Column, Column]
    """the axes as quantities, over all their values"""
    codes: tuple[columns.Codes, columns.Codes]
    """(N,) each"""

    @classmethod
    def of(cls, key: str, names: tuple[str, str], xy: NDArray[np.float32]) -> Self:
        ends = zip(xy.min(0).tolist(), xy.max(0).tolist(), strict=True)
        x, y = (Column(f"{key} {i}", low, high) for i, (low, high) in enumerate(ends))
        codes = columns.encode(xy[:, 0], x), columns.encode(xy[:, 1], y)
        return cls(names, xy, (x, y), codes)


def rows_on_plane(run: RunReader, key: str) -> RowsOnPlane | None:
    """The plane of a key; None if there is none.

    A key is `contrast@WEIGHTS` or `principal@WEIGHTS`, where WEIGHTS are a fit's step or the label
    of a weighing; `policy@`; `model@`; or `two@NAME|NAME`, dimensions by their names.
    """
    return _rows_on_plane(run, key, _plane_source(run, key))


def _plane_source(run: RunReader, key: str) -> Source | None:
    """The weights that a plane is fitted to; None for a plane of others."""
    kind, _, of = key.partition("@")
    return sources(run).get(of) if kind in (CONTRAST, PRINCIPAL) else None


@cached("buffer", "model")
def _rows_on_plane(run: RunReader, key: str, source: Source | None) -> RowsOnPlane | None:
    kind, _, of = key.partition("@")
    if kind == TWO:
        x, _, y = of.partition("|")
        known = {one.name for one in columns.recorded(run)}
        if not {x, y} <= known:
            return None
        pair = [columns.values(run, name).astype(np.float32) for name in (x, y)]
        return RowsOnPlane.of(key, (x, y), np.stack(pair, 1))
    if kind in (POLICY, MODEL):
        return _network_plane(run, kind, key)
    if source is not None:
        found = _plane(run, kind, source)
        with LOCK:
            _LAST_PLANES[run.path, key] = found
    with LOCK:
        plane = _LAST_PLANES.get((run.path, key))
    if plane is None:
        return None
    return RowsOnPlane.of(key, plane.names, planes.of_rows(plane, buffer.recorded(run).rows))


@cached("buffer")
def _plane(run: RunReader, kind: str, source: Source) -> planes.Plane:
    """The contrast plane, or the principal components, of the rows of these weights."""
    part = buffer.recorded(run).rows[source.first : source.end]
    if kind == CONTRAST:
        return planes.contrast_of(part, source.weight, buffer.obs_and_action_names(run))
    return planes.principal_of(part, buffer.obs_and_action_names(run))


def network_planes(run: RunReader) -> dict[str, str]:
    """The keys of the planes of a run's networks: its last policy and its stored model."""
    if run.env == ROAD:
        return {}
    found = {POLICY: f"{POLICY}@"} if run.has_policy() else {}
    return found | ({MODEL: f"{MODEL}@"} if buffer.has_model(run) else {})


def dimensions(run: RunReader) -> list[Column]:
    """The task's own dimensions, s then a."""
    return [one for one in columns.recorded(run) if one.name not in columns.ROW_QUANTITIES]


def _network_plane(run: RunReader, kind: str, key: str) -> RowsOnPlane | None:
    """The principal components of the last hidden layer of the last policy or the stored model."""
    rows = buffer.recorded(run).rows.torch()
    kept = buffer.stored_policy(run) if kind == POLICY else buffer.stored_model(run)
    network = kept.predictor if isinstance(kept, StoredModel) else kept
    if not isinstance(network, StoredPolicy | NeuralDynamics):
        return None

    def hidden(part: slice | NDArray[np.int64]) -> NDArray[np.float32]:
        given = (rows.obs,) if kind == POLICY else (rows.obs, rows.action)
        return network.hidden(*(one[part] for one in given)).numpy()

    plane = planes.of_layer(hidden(spread(len(rows), SAMPLED_ROWS)))
    return RowsOnPlane.of(key, plane.names, planes.coordinates(plane, len(rows), hidden))


@cached("buffer", "model")
def explained_share(run: RunReader, key: str, source: Source) -> float:
    """The share of the log weights that a plane explains on held-out rows; NaN without a plane."""
    part = spread(len(source.weight), SAMPLED_ROWS)
    if fitted := _plane_source(run, key):  # a plane that is not shown needs no more rows than these
        rows = buffer.recorded(run).rows[source.first + part]
        xy = planes.of_rows(_plane(run, key.partition("@")[0], fitted), rows)
    elif (place := rows_on_plane(run, key)) is not None:
        xy = place.xy[source.first + part]
    else:
        return np.nan
    return planes.explained_share(xy, source.weight[part])


def source_codes(run: RunReader, source: Source, name: str) -> tuple[columns.Codes, Column] | None:
    """The codes (N,) of a quantity of the rows of these weights; None if it is not known."""
    if name == AGE.name:
        count = len(source.weight)
        return (np.arange(count) * columns.TOP // max(count - 1, 1)).astype(np.uint16), AGE
    if name == WEIGHT.name:
        return columns.weight_codes(source.weight), WEIGHT
    if name == RANK.name:
        return columns.rank_codes(columns.weight_codes(source.weight)), RANK
    if name == DISTANCE.name:
        far = distances(run, source)
        return None if far is None else (columns.encode(far, DISTANCE), DISTANCE)
    for column in columns.recorded(run):
        if column.name == name:
            return columns.codes(run, name)[source.first : source.end], column
    return None


def selection_mask(run: RunReader, source: Source, selection: Selection) -> Mask:
    """A mask (N,) of the rows of these weights that a selection chooses.

    What it says of quantities and planes that this buffer lacks is left out.
    """
    mask = np.ones(len(source.weight), bool)
    for name, interval in selection.intervals.items():
        if (found := source_codes(run, source, name)) is not None:
            mask &= between(*found, interval)
    place = rows_on_plane(run, selection.outline.plane) if selection.outline else None
    if selection.outline and place:
        x, y = (
            columns.decode(codes[source.first : source.end], axis)
            for codes, axis in zip(place.codes, place.axes, strict=True)
        )
        mask &= inside(selection.outline.corners, x, y)
    return mask


def read_ahead(run: RunReader) -> None:
    """Make what the map of a run asks for first, unless its buffer is too large to be kept."""
    if run.env == ROAD or run.buffer_bytes() > STUDIO_CACHE_BYTES:
        return
    seen = first_weight_reader(run)
    own = list(fit_sources(seen).values())
    if own and buffer.weighed_rows(seen, (last := own[-1]).weight, last.end) is not None:
        for kind in (CONTRAST, PRINCIPAL):
            explained_share(seen, f"{kind}@{last.label}", last)
        rows_on_plane(seen, f"{CONTRAST}@{last.label}")
        columns.recorded(seen)


def nearest(run: RunReader, source: Source, row: int) -> NDArray[np.int64]:
    """The recorded numbers (NEAREST,) of the rows of the buffer nearest to a recorded row.

    As the policy's nearest (`tom.analysis.why`): by (s, a, s' - s) in standard deviations.
    """
    part = buffer.recorded(run).rows[source.first : source.end].torch()
    here = row - source.first
    return source.first + why.nearest(part, here, part, NEAREST, itself=here).index.numpy()


def plane_for_browser(run: RunReader, key: str) -> dict | None:
    """What the browser needs to know of a plane."""
    place = rows_on_plane(run, key)
    if place is None:
        return None

    def codes(i: int) -> columns.Codes:
        found = rows_on_plane(run, key)
        assert found is not None
        return found.codes[i]

    made = place.codes if run.status.alive else (None, None)
    axes = [
        _column_for_browser(run, axis, place.names[i], partial(codes, i), made[i])
        for i, axis in enumerate(place.axes)
    ]
    return {"key": key, "axes": axes}


def _column_for_browser(
    run: RunReader,
    column: Column,
    name: str,
    make: Callable[[], columns.Codes],
    made: columns.Codes | None = None,
) -> dict:
    """A quantity of the record with the address of its codes."""
    version = run.version("buffer"), run.version("model")
    url = publish_array((run.path, version, column), make, made)
    return {"name": name, "low": column.low, "high": column.high, "url": url}


def source_for_browser(run: RunReader, source: Source) -> dict:
    """What the browser needs to know of weights."""
    label, of_fit, count = source.label, source.weighing is None, len(source.weight)

    def current() -> Source:
        found = (
            _fit_source(run, int(label), buffer.length(run))
            if of_fit
            else weighing_sources(run).get(label)
        )
        if found is None:
            raise UserError(f"the weights of {label} are no longer there")
        return found

    def distance_codes() -> columns.Codes:
        try:
            found = distances(run, current())
        except UserError:  # a training has replaced this fit
            found = None
        return columns.encode(np.full(count, np.nan) if found is None else found, DISTANCE)

    key = run.path, label, source.version
    far = publish_array((*key, DISTANCE), distance_codes) if knows_policy(run, source) else None
    made = columns.weight_codes(source.weight) if run.status.alive else None
    return {
        "label": label, "first": source.first, "count": count,
        "step": int(label) if of_fit else None,
        "url": publish_array(key, lambda: columns.weight_codes(current().weight), made),
        "distance": far,
    }  # fmt: skip


def columns_for_browser(run: RunReader, sources: Sequence[Source]) -> list[dict]:
    """What the browser needs to know of the quantities of the record, and of those of sources."""
    sampled = f" (of {ERROR_ROWS:,} rows)" if buffer.length(run) > ERROR_ROWS else ""
    found = [
        _column_for_browser(run, one, one.name, partial(columns.codes, run, one.name))
        | {"note": sampled if one.name == ERROR else ""}
        for one in columns.recorded(run)
    ]
    if any(knows_policy(run, one) for one in sources):
        of_source = {"name": DISTANCE.name, "low": DISTANCE.low, "high": DISTANCE.high}
        place = sum(one["name"] in columns.ROW_QUANTITIES for one in found)
        found.insert(place, {**of_source, "note": "", "url": None})
    return found
