"""`tom.record`: the record of a training loop of the user's own."""

import atexit
import json
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial, wraps
from pathlib import Path
from typing import Any, Concatenate, Literal, ParamSpec, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from tom.analysis.ordered_data import card_of_run
from tom.config import OWN_LOOP, OwnLoopConfig
from tom.data.card import FEW_ROWS
from tom.errors import UserError, invalid_value, reason
from tom.events import (
    Collected,
    Episode,
    Evaluation,
    KeptPolicy,
    Metrics,
    Notice,
    Tick,
    TrainedPolicy,
    Weights,
)
from tom.own_loop.opening import open_record, resolve_task
from tom.own_loop.policy import PolicyCopier
from tom.own_loop.rows import AUTORESET, BLOCK, Autoreset, Rows
from tom.policy.collect import Evaluator
from tom.policy.stored import StoredPolicy
from tom.record import RunReader, Store, decode, layout
from tom.record.files import plain

FLUSH_S = 2.0
"""seconds after which rows are written although they are few"""
COPY_ERROR = 0.1
"""root mean square, of actions in [-1, 1], from which on a learnt copy of a policy is not told as
the policy"""

Arrays = dict[str, NDArray]
P = ParamSpec("P")


def _guarded(
    method: Callable[Concatenate["OwnRun", P], None],
) -> Callable[Concatenate["OwnRun", P], None]:
    """The method, after whose errors the loop goes on (`strict`: they are raised).

    Bad input is not recorded; a disk that cannot be written ends the record as failed.
    """

    @wraps(method)
    def guarded(self: "OwnRun", *args: P.args, **kwargs: P.kwargs) -> None:
        if self.closed:
            return
        try:
            method(self, *args, **kwargs)
        except OSError as error:
            self.closed = True
            text = f'{reason(error)}: free some space, then start again with resume="auto"'
            self._recorder.finish("failed", f"step {self.step}: {text}")
            if self._strict:
                raise
            warnings.warn(f"run {self.name} is not recorded any further: {text}", stacklevel=2)
        except (UserError, TypeError, ValueError) as error:
            why = f"{method.__name__}: {reason(error)}"
            if self._strict:
                raise UserError(why) from error
            warnings.warn(f"run {self.name}: not recorded: {why}", stacklevel=2)
            self._notice("not-recorded", why)

    return guarded


class OwnRun:
    """The record of a training loop of your own in the run folder `store`/`name`: `tom.record`.

    `env` is a task of Gymnasium (`Hopper-v5`, `module:Id-v0`) or of `tom train`; `config` are your
    settings, by which runs are told apart; `steps` are planned. With `envs` above 1 the leading
    axis of all rows is that of the environments; `autoreset` is their mode, None if next_obs is
    always the step's own. With `resume="auto"` a run of that name goes on: at `step`, if it is
    given, after which everything is cut off. Raises UserError. Later errors are warnings, and the
    loop goes on, unless it is `strict`.

    A context manager, which ends as `stopped` after Ctrl-C and as `failed` after another exception;
    else call `close`.
    """

    def __init__(
        self,
        name: str,
        *,
        env: str,
        store: str | Path = "runs",
        config: Mapping[str, Any] | None = None,
        steps: int = 1_000_000,
        seed: int = 0,
        envs: int = 1,
        autoreset: Autoreset | None = None,
        resume: Literal["auto"] | None = None,
        step: int | None = None,
        strict: bool = False,
    ) -> None:
        known, place = resolve_task(env), Store(Path(store))
        if envs < 1 or autoreset not in (None, *AUTORESET) or resume not in (None, "auto"):
            raise UserError(
                f"envs {envs}, autoreset {autoreset}, resume {resume}: envs is at least 1, "
                f"autoreset is one of {', '.join(AUTORESET)} or None, resume is 'auto' or None"
            )
        own = json.loads(json.dumps(plain(config or {}), default=str))
        chosen: dict[str, Any] = {"steps": steps, "seed": seed, "own": own}
        try:
            settings = OwnLoopConfig(env=known.name, learner=OWN_LOOP, **chosen)
        except ValidationError as error:
            raise UserError(invalid_value(error)) from None
        self._recorder = open_record(place, name, settings, resume, step)
        self.name, self.path, self.closed = name, self._recorder.writer.path, False
        rows, numbers = RunReader(self.path).buffer()
        handed = int(numbers.max(initial=0)) if step is None or not len(numbers) else step
        self._known, self._strict = known, strict
        self._rows = Rows(known, envs, autoreset, handed, numbers)
        self.began_at = handed
        """the step from which the loop goes on"""
        self._step, self._returned = 0, -1  # the last that was named, and with eval/return
        self._flushed = time.monotonic()
        self._policy: tuple[int, Arrays] | None = None
        self._copier = PolicyCopier(known)
        self._evaluator = lru_cache(maxsize=1)(partial(Evaluator, known))  # by its episodes
        self._episodes: tuple[int, list[Episode]] = (-1, [])
        # What agents saw in the newest rows of the record, whose blocks may be as small as a row.
        self._newest_obs = np.array(rows.obs[-BLOCK:]).reshape(-1, known.obs_dim)
        self._next_card, self._notices_given = FEW_ROWS, set[str]()
        self.live: list[Callable[[], str]] = []
        """give the reason of a live weighing that failed, else nothing"""
        self._live: tuple[str, int, NDArray[np.float32]] | None = None
        for code, text in known.notices:
            self._notice(code, text)
        atexit.register(self._at_exit)

    @property
    def step(self) -> int:
        """The number of steps handed in, of all environments together."""
        return self._rows.handed

    # What a loop hands in

    @_guarded
    def transitions(
        self,
        obs: Any,
        action: Any,
        reward: Any,
        next_obs: Any,
        terminated: Any,
        truncated: Any,
        infos: Mapping[str, Any] | None = None,
    ) -> None:
        """Append one step or many, in the task's own units.

        obs, next_obs (..., O), action (..., A), the others (...). Leading axes: none or (T,); with
        several environments (E,) or (T, E). `infos` are the vector environment's, whose `final_obs`
        counts with same-step autoreset.
        """
        step = obs, action, reward, next_obs, terminated, truncated
        for at, total, length in self._rows.add(step, infos):
            values = {"train/return": total, "train/length": float(length)}
            self._recorder.consume(Metrics(at, values))
        if self._rows.count >= BLOCK:
            self._flush()
        if time.monotonic() - self._flushed > FLUSH_S:
            self._flush()
            self._flushed = time.monotonic()
            self._recorder.consume(Tick(max(self.step, self._step), "collect"))

    @_guarded
    def cut(self) -> None:
        """Truncate the episodes that are not over: all environments are reset."""
        if self._rows.cut():
            self._flush()
            self._recorder.writer.cut()

    @_guarded
    def metrics(self, step: int, values: Mapping[str, Any]) -> None:
        """Record numbers by name at env step `step`; steps never go back."""
        given = {
            name: getattr(value, "item", lambda v=value: v)() for name, value in values.items()
        }
        numbers = {str(name): float(value) for name, value in given.items()}
        self._recorder.consume(Metrics(self._checked_step(step), numbers))
        if "eval/return" in numbers:
            self._returned = self._step

    @_guarded
    def weights(self, step: int, weights: Any) -> None:
        """Record the weights (N,) of the newest N rows handed in, oldest first; they get mean 1.

        Non-negative numbers of any kind: priorities, recency, a loss.
        """
        given, handed = np.asarray(weights, np.float64), self.step
        if given.ndim != 1 or not 0 < len(given) <= handed:
            raise UserError(
                f"shape {given.shape} for {handed} rows handed in: one for each of the newest N"
            )
        if not np.isfinite(given).all() or (given < 0).any() or not given.any():
            raise UserError("they must be finite, non-negative and not all zero")
        at = self._checked_step(step)
        self._flush()
        kept = self._rows.in_record(given)
        if not kept.any():
            raise UserError("none of the recorded rows has any weight yet")
        weight = (kept / kept.mean()).astype(np.float32)
        recorded = len(self._rows.recorded)
        self._recorder.consume(Weights(at, weight, rows=recorded))

    @_guarded
    def policy(self, step: int, policy: Any) -> None:
        """Keep the policy of env step `step`: SB3's model, a torch module or a function.

        `tom.own_loop.policy` says what it may answer, and what becomes of it.
        """
        at = self._checked_step(step)
        self._flush()
        obs = np.concatenate((self._newest_obs, self._rows.unfinished_obs()))
        arrays, error = self._copier.copy(policy, obs)
        self._policy = at, arrays
        self._recorder.consume(KeptPolicy(at, arrays))
        if error is not None:
            self._recorder.consume(Metrics(at, {"policy/copy_error": error}))
            if error > COPY_ERROR:
                self._notice(
                    "policy-copy",
                    f"the kept copy of the policy differs from its answers by {error:.2f} "
                    "of actions in [-1, 1]: what is measured with it is of the copy",
                )

    @_guarded
    def episode(
        self,
        step: int,
        states: Any,
        rewards: Any,
        actions: Any = None,
        *,
        terminated: bool = False,
        truncated: bool = False,
    ) -> None:
        """Record an evaluation's episode of H steps at env step `step`, to be replayed.

        `states` are observations (H + 1, O), or `(qpos, qvel)`, (H + 1, nq) and (H + 1, nv);
        rewards (H,), actions (H, A), all in the task's own units. `eval/return` is the mean of the
        step's episodes, unless `metrics` gave it before.
        """
        reward = np.asarray(rewards, np.float32)
        h, known = len(reward), self._known
        shapes: dict[str, tuple[NDArray, tuple[int, ...]]] = {"rewards": (reward, (h,))}
        if isinstance(states, tuple):
            qpos, qvel = (np.asarray(part, np.float32) for part in states)
            shapes |= {"qpos": (qpos, (h + 1, known.nq)), "qvel": (qvel, (h + 1, *qvel.shape[1:]))}
            left_out = known.root_dims or 0
            obs = np.concatenate((qpos[..., left_out:], qvel), -1)
        else:
            obs, qpos, qvel = known.unit_obs(np.asarray(states, np.float64)), None, None
            shapes["states"] = obs, (h + 1, known.obs_dim)
            if known.root_dims is not None and obs.shape == shapes["states"][1]:
                qpos, qvel = known.qpos_from_obs(obs), obs[:, known.nq - known.root_dims :]
        action = np.full((h, known.action_dim), np.nan, np.float32)
        if actions is not None:
            action = known.unit_action(np.asarray(actions, np.float64))
            shapes["actions"] = action, (h, known.action_dim)
        for name, (array, shape) in shapes.items():
            if array.shape != shape or not h:
                raise UserError(f"{name} has shape {array.shape}, not {shape}")
        episode = Episode(reward, action, obs, qpos, qvel, terminated, truncated)
        self._add_episodes(self._checked_step(step), [episode])

    @_guarded
    def evaluate(self, step: int, episodes: int = 3) -> None:
        """Play episodes of the last kept policy's mean actions in an environment of its own.

        They are recorded as replays, with `eval/return`; once a step. This takes the loop's time.
        """
        if self._policy is None:
            raise UserError("no policy has been kept yet: call policy before")
        at, policy = self._checked_step(step), StoredPolicy(self._policy[1])
        if at == self._episodes[0]:
            return
        self._add_episodes(at, self._evaluator(episodes).run(policy.mean, at))

    def latest_weights(self, learner: str = "tom") -> NDArray[np.float32]:
        """The newest live weights (`tom.weigh_live`) of the rows handed in, oldest first: (N,).

        Rows without a weight have 1, the mean: those that came later, and all before the first fit.
        """
        weights = np.ones(self.step, np.float32)
        live = RunReader(self.path / layout.LIVE / learner)
        steps = live.snapshot_steps()
        if not steps:
            return weights
        if self._live is None or self._live[:2] != (learner, steps[-1]):
            self._live = learner, steps[-1], live.snapshot(steps[-1])["weight"].to_numpy(np.float32)
        found = self._live[2]
        numbers = self._rows.recorded[: len(found)]
        weights[numbers - 1] = found[: len(numbers)]
        return weights

    # The end

    def close(self, error: BaseException | None = None) -> None:
        """End the record: it is finished, with the last policy that was kept.

        After an `error` it has failed, and was stopped by Ctrl-C.
        """
        if self.closed:
            return
        self.closed = True
        if isinstance(error, SystemExit) and not error.code:
            error = None
        for why in filter(None, (failed() for failed in self.live)):
            warnings.warn(f"run {self.name}: the live weighing failed: {why}", stacklevel=2)
        atexit.unregister(self._at_exit)
        try:
            self._rows.cut()
            self._flush()
            at = max(self.step, self._step)
            self._recorder.consume(Tick(at, "collect"))
            if error is None and self._policy:
                self._recorder.consume(TrainedPolicy(at, self._policy[1]))
        except OSError as full:
            error = error or full
        self._recorder.__exit__(None if error is None else type(error), error, None)

    def _at_exit(self) -> None:
        self.close(getattr(sys, "last_value", None))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close(error)

    # Parts

    def _checked_step(self, step: int) -> int:
        """`step`, checked. Raises UserError."""
        if not isinstance(step, int | np.integer) or step < 0:
            raise UserError(f"step {step!r} is not a whole number from 0 on")
        if step < self._step:
            raise UserError(f"step {step} comes after step {self._step}: steps never go back")
        self._step = int(step)
        return self._step

    def _notice(self, code: str, text: str) -> None:
        """Record a notice, each code once."""
        if code not in self._notices_given:
            self._notices_given.add(code)
            self._recorder.consume(Notice(max(self.step, self._step), code, text))

    def _flush(self) -> None:
        for rows, numbers in self._rows.blocks():
            self._recorder.consume(Collected(self.step, rows, numbers))
            self._newest_obs = np.concatenate((self._newest_obs, np.asarray(rows.obs)))[-BLOCK:]
            if numbers[-1] >= self._next_card and len(rows) >= FEW_ROWS:
                self._next_card = 8 * int(numbers[-1])
                for code, text in card_of_run(rows, self._known).notices():
                    self._notice(code, text)

    def _add_episodes(self, step: int, episodes: Sequence[Episode]) -> None:
        at, earlier = self._episodes
        self._episodes = step, [*(earlier if at == step else ()), *episodes]
        if self._returned == step:  # the caller's own number counts
            arrays = decode.episode_arrays(self._episodes[1])
            self._recorder.writer.arrays(layout.episodes(step), arrays)
        else:
            self._recorder.consume(Evaluation(*self._episodes))


record = OwnRun
