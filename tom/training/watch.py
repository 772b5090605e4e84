"""Detects problems of a training from its events, with advice.

A loss that is NaN ends the training, because nothing after it is meaningful. Every other anomaly
gives a notice, and the training goes on.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from tom.config import OnlineConfig, RunConfig, SacRecordingConfig
from tom.data.card import FEW_ROWS, Card, dimension_list, make_card, with_rule
from tom.data.replay import ReplayBuffer
from tom.envs import task
from tom.envs.termination import learns_ends, rule
from tom.errors import DivergedError
from tom.events import Event, Metrics, Notice, TrainedPolicy, Weights
from tom.metrics import MODEL, SHORTER, require_finite

EXPLODED_SHARE = 1e-3
"""share of modelled steps far outside the data from which a notice is given"""
SHORT_EPISODES = 10
"""number of successive one-step episodes from which a notice is given"""


class Watch:
    """Checks every event of one training; its state is part of a checkpoint.

    The card of the buffer is taken at the first fit, whenever the buffer has doubled since, and at
    the end.
    """

    def __init__(self, config: RunConfig, replay: ReplayBuffer | None = None) -> None:
        """`replay` is the training's buffer, if its rows come from a task of Gymnasium's."""
        self._config, self._replay = config, replay
        self._given: set[str] = set()
        self._short = 0  # episodes of one step in a row
        self._checked = 0  # rows of the last card

    def checked(self, events: Iterable[Event]) -> Iterator[Event]:
        """The events, each followed by its notices. Raises DivergedError."""
        if self._replay is not None:
            for code, text in task(self._config.env).notices:
                yield from self._once(0, code, text)
        for event in events:
            yield event  # recorded first, then checked
            yield from self.check(event)

    def check(self, event: Event) -> Iterator[Notice]:
        match event:
            case Weights():
                yield from self._card(event.env_step, 2 * self._checked)
                yield from self._once(event.env_step, "small-buffer", self._small())
            case TrainedPolicy():
                yield from self._card(event.env_step, self._checked + 1)
            case Metrics():
                yield from self._metrics(event.env_step, event.values)
            case _:
                return

    def _metrics(self, env_step: int, values: Mapping[str, float]) -> Iterator[Notice]:
        require_finite(values, env_step)
        if "critic/loss" in values:
            yield from self._once(env_step, "small-buffer", self._small())
        if "train/length" in values:
            self._short = self._short + 1 if values["train/length"] == 1 else 0
            if self._short >= SHORT_EPISODES:
                yield from self._once(env_step, "short-episodes", SHORT)
        if values.get("discriminator/accuracy", 0.0) >= 1.0:
            yield from self._once(env_step, "perfect-discriminator", PERFECT)
        yield from _rollouts(env_step, values)

    def _once(self, env_step: int, kind: str, message: str) -> Iterator[Notice]:
        if message and kind not in self._given:
            self._given.add(kind)
            yield Notice(env_step, kind, message)

    def _card(self, env_step: int, least: int) -> Iterator[Notice]:
        """What contradicts itself in the buffer, if it has at least `least` rows by now."""
        if self._replay is None or len(self._replay) < max(least, FEW_ROWS):
            return
        self._checked = len(self._replay)
        rows, known = self._replay.transitions(), task(self._config.env)
        card = replace(make_card(rows), task=known.name, limit=known.max_episode_steps)
        own_rule = getattr(getattr(self._config, "model", None), "termination", None)
        if not learns_ends(known, own_rule):
            name = own_rule or f"of {known.name}"
            card = with_rule(card, rule(known, own_rule), rows, name)
        yield from self._once(env_step, "constant-dimension", _constant(card))
        for code, text in card.notices():
            yield from self._once(env_step, code, text)

    def _small(self) -> str:
        match config := self._config:
            case OnlineConfig():
                rows = config.exploration_steps
                batch = min(config.model.batch_size, config.sac.batch_size)
            case SacRecordingConfig():
                rows, batch = max(config.exploration_steps, 1), config.sac.batch_size
            case _:
                return ""
        return (
            f"the buffer holds {rows} rows at first, fewer than a minibatch of {batch}: rows are "
            f"drawn with replacement; try --exploration-steps {batch} or more"
            if rows < batch
            else ""
        )

    # State

    def state_dict(self) -> dict[str, Any]:
        return {
            "said": sorted(self._given),
            "short": self._short,
            "checked": self._checked,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._given, self._short = set(state["said"]), state["short"]
        self._checked = state["checked"]


SHORT = (
    f"the last {SHORT_EPISODES} episodes ended after one step: nothing can be learnt about later "
    "steps; check the task's termination and its start states"
)
PERFECT = (
    "the discriminator tells the policy's transitions from all others without a mistake: its "
    "log ratio has no scale and the weights follow it; try a larger policy buffer, or "
    "--tom.label-smoothing 0.1"
)


def _constant(card: Card) -> str:
    still = card.obs.low == card.obs.high
    if not still.any() or still.all():
        return ""
    return (
        f"observation {dimension_list(still)} of {len(still)} never changed: nothing can be learnt "
        "from it; leave out what does not change"
    )


def _rollouts(env_step: int, values: Mapping[str, float]) -> Iterator[Notice]:
    diverged = values.get("rollout/diverged", 0.0)
    if diverged >= 1.0:
        raise DivergedError(f"step {env_step}: no modelled step is finite: {MODEL}")
    if diverged > 0.0:
        yield Notice(
            env_step,
            "rollout-diverged",
            f"{diverged:.2%} of the modelled steps were not finite and were left out: "
            f"{MODEL} or {SHORTER}",
        )
    exploded = values.get("rollout/exploded", 0.0)
    if exploded > EXPLODED_SHARE:
        yield Notice(
            env_step,
            "rollout-exploded",
            f"{exploded:.2%} of the modelled steps lead far outside the data (100 times its "
            f"largest observation): {MODEL} or {SHORTER}",
        )
