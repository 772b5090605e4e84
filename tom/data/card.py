"""The card of recorded data: its facts in one pass, and where they contradict each other.

Whoever brings data, a policy or a task may have made one of a few common mistakes, after which all
numbers look right and are not. Each has a notice: a code, and a text that names the fact, the
likely cause and the fix. docs/your-own.md lists them for users.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tom.data.transitions import Transitions
from tom.readable import short

if TYPE_CHECKING:
    from torch import Tensor

    from tom.data.transitions import TensorTransitions

Notice = tuple[str, str]
"""code and text"""

FEW_ROWS = 100
FOLLOWS = 1e-3
"""how far, in standard deviations, an obs may lie from the next_obs before it and still follow"""
UNORDERED = 0.5
"""share of breaks from which on rows without `truncated` are taken to be in no order"""
STRIDES = range(2, 65)
"""numbers of environments whose rows may be interleaved"""
LEVELS = 100
"""single precision has to tell so many values apart within a standard deviation"""
ROUNDING = 1e-13
"""a spread relative to the values, below which double precision sees only rounding"""


@dataclass(frozen=True)
class Range:
    """What D columns hold, (D,) each."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    mean: NDArray[np.float64]
    std: NDArray[np.float64]

    @staticmethod
    def of(columns: NDArray) -> Range:
        """Of columns (N, D), N > 0; one at a time in double precision."""
        moments = []
        for d in range(columns.shape[1]):
            column = columns[:, d].astype(np.float64)
            moments.append((column.min(), column.max(), column.mean(), column.std()))
        return Range(*np.array(moments).reshape(-1, 4).T)

    @property
    def largest(self) -> NDArray[np.float64]:
        return np.maximum(np.abs(self.low), np.abs(self.high))

    def moved(self, offset: NDArray, scale: NDArray) -> Range:
        """That of the columns `offset + scale * column`, for scales above zero."""
        low, high, mean = (offset + scale * x for x in (self.low, self.high, self.mean))
        return Range(low, high, mean, scale * self.std)

    def described(self) -> dict[str, list[float]]:
        return {name: values.tolist() for name, values in vars(self).items()}


@dataclass(frozen=True)
class PolicyFacts:
    """What a policy answers to the data's observations, before anything is clipped.

    `own` has the answers in the policy's own form: actions in the task's units, or means.
    `log_std` is its second output, `drawn` whether its means differ from call to call. `spread` is
    the standard deviation of the actions that are taken, in [-1, 1], and `beyond` the share of
    those that lay farther outside the bounds than these are apart.
    """

    own: Range
    spread: float
    log_std: tuple[float, float] | None = None
    drawn: bool = False
    beyond: float = 0.0
    returned: float | None = None  # mean return of its whole episodes in the task

    def described(self) -> dict[str, Any]:
        spread = {"spread": self.spread, "return": self.returned}
        return {"action": self.own.described(), **spread, "log_std": self.log_std}


@dataclass(frozen=True)
class Card:
    """The facts of N recorded transitions, and of what they are to be used with.

    `breaks` are rows without an end whose successor does not follow; `joined` are rows with an end
    from which the next row goes on. With `stride` k, most rows are followed k rows later. At
    `longest`, the length of the longest episodes, `ends_at_longest` of `longest_episodes` end.
    """

    rows: int
    episodes: int
    terminations: int
    truncations: int
    both_flags: int
    breaks: int
    joined: int
    stride: int
    longest: int
    longest_episodes: int
    ends_at_longest: int
    starts: Range
    obs: Range
    action: Range
    reward: Range
    lost: int = 0  # terminations of rows without next_obs, which are left out
    # The task
    task: str = ""
    limit: int | None = None
    bounds: tuple[NDArray, NDArray] | None = None  # of its actions, (A,) each
    seen: Range | None = None  # observations as the networks see them
    rule: str = ""
    missed: int | None = None  # terminations that its rule does not know
    invented: int | None = None  # other rows that it would end
    # The policy, and notices of others: the task's about itself, a weighing's about its weights
    policy: PolicyFacts | None = None
    others: tuple[Notice, ...] = ()

    def notices(self) -> tuple[Notice, ...]:
        """What contradicts itself, each once."""
        return (
            *_value_notices(self), *_flag_notices(self), *_task_notices(self),
            *_policy_notices(self), *self.others,
        )  # fmt: skip

    def described(self) -> dict[str, Any]:
        """The card as it is stored in `report.json`."""
        counts = ("rows", "episodes", "terminations", "truncations", "breaks")
        ranges = ("starts", "obs", "action", "reward")
        return {
            **{name: getattr(self, name) for name in counts},
            **{name: getattr(self, name).described() for name in ranges},
            "rule": {"name": self.rule, "missed": self.missed, "invented": self.invented},
            "policy": self.policy and self.policy.described(),
            "notices": [{"code": code, "text": text} for code, text in self.notices()],
        }


def make_card(rows: Transitions, ordered: bool = True) -> Card:
    """The card of N > 0 rows. Without `ordered` their next_obs were made of the rows' order."""
    t = rows.numpy()
    obs, next_obs = np.asarray(t.obs), np.asarray(t.next_obs)
    terminated, truncated = np.asarray(t.terminated) != 0, np.asarray(t.truncated) != 0
    ends = terminated | truncated
    follows = successive(obs, next_obs) if ordered else ~ends[:-1]
    breaks = int((~follows & ~ends[:-1]).sum())
    last = np.flatnonzero(np.append(ends[:-1], True))
    length = np.diff(last, prepend=-1)
    longest = length == length.max()
    starts = np.append(0, last[:-1] + 1)
    stride = 0
    if breaks > UNORDERED * len(obs):
        most = 0.5 * len(obs)
        later = (k for k in STRIDES if (successive(obs, next_obs, k) & ~ends[:-k]).sum() > most)
        stride = next(later, 0)
    return Card(
        rows=len(obs),
        episodes=len(last),
        terminations=int(terminated.sum()),
        truncations=int(truncated.sum()),
        both_flags=int((terminated & truncated).sum()),
        breaks=breaks,
        joined=int((follows & ends[:-1]).sum()),
        stride=stride,
        longest=int(length.max()),
        longest_episodes=int(longest.sum()),
        ends_at_longest=int((longest & terminated[last]).sum()),
        starts=Range.of(obs[starts]),
        obs=Range.of(obs),
        action=Range.of(np.asarray(t.action)),
        reward=Range.of(np.asarray(t.reward)[:, None]),
    )


def with_rule(
    card: Card, ends: Callable[[Tensor], Tensor], rows: TensorTransitions, name: str
) -> Card:
    """The card beside a termination rule, which maps next_obs (N, O) to a bool tensor (N,)."""
    says, fell = ends(rows.next_obs), rows.terminated > 0
    missed, invented = int((fell & ~says).sum()), int((says & ~fell).sum())
    return replace(card, rule=name, missed=missed, invented=invented)


def successive(obs: NDArray, next_obs: NDArray, by: int = 1) -> NDArray[np.bool_]:
    """Which rows go on `by` rows later: next_obs (N, O) is that row's obs, (N - by,).

    But for rounding to the coarser type of the two, and for `FOLLOWS`.
    """
    types = [x.dtype for x in (obs, next_obs) if x.dtype.kind == "f"]
    rounding = max((float(np.finfo(t).eps) for t in types), default=0.0)
    follows = np.ones(max(len(obs) - by, 0), bool)
    for d in range(obs.shape[1]):
        after, before = (x[:, d].astype(np.float64) for x in (obs, next_obs))
        gap = np.abs(after[by:] - before[:-by])
        follows &= gap <= FOLLOWS * after.std() + rounding * np.abs(after[by:])
    return follows


# What may be wrong


def _value_notices(card: Card) -> Iterator[Notice]:
    if card.rows < FEW_ROWS:
        yield (
            "few-rows",
            f"a buffer of size {card.rows} is too small for a network to learn from: record at "
            f"least some {FEW_ROWS}, better thousands",
        )
    seen = card.seen or card.obs
    step = np.spacing(seen.largest.astype(np.float32)).astype(np.float64)
    changes = seen.std > ROUNDING * np.maximum(seen.largest, 1e-300)
    far = (card.obs.largest > 1e3) | (np.abs(seen.std - card.obs.std) > 0.5 * card.obs.std)
    lost = changes & far & (seen.std < LEVELS * step)  # far out, or by the task's bounds
    if lost.any():
        mean, std = float(card.obs.mean[lost][0]), float(card.obs.std[lost][0])
        yield (
            "precision",
            "single precision cannot tell the values of observation "
            f"{dimension_list(lost)} apart (a mean of {short(mean)}, a standard deviation of "
            f"{short(std)}): an offset, or bounds that are far too wide; subtract it, or give the "
            "observation space bounds that the values fill",
        )


def _flag_notices(card: Card) -> Iterator[Notice]:
    goes_on = card.joined > 0.5 * card.rows or card.lost > 0
    rows, terminations = card.rows + card.lost, card.terminations + card.lost
    inverted = card.rows > 1 and terminations > 0.5 * rows and goes_on
    if inverted:
        yield (
            "flags",
            f"{100 * terminations / rows:.0f} % of the rows are terminated, and yet "
            "they go on: is 'terminated' a mask, 1 - done? Write 1 where the task ended",
        )
    elif order := _order_fault(card):
        yield "order", order
    if card.both_flags > max(1, 0.1 * card.truncations) and not inverted:
        yield (
            "both-flags",
            f"{card.both_flags:,} rows are terminated and truncated, and count as terminated: "
            "if a time limit ended them, terminated has to be 0 there",
        )
    most = card.ends_at_longest > 0.5 * card.longest_episodes
    at_limit = card.longest == card.limit
    if most and card.longest >= 10 and card.ends_at_longest >= (2 if at_limit else 4):
        limit = f"the limit of {card.task}" if at_limit else "and none lasts longer"
        yield (
            "ends-at-limit",
            f"{card.ends_at_longest:,} episodes terminate after exactly {card.longest:,} steps, "
            f"{limit}: a time limit recorded as a termination; it belongs in 'truncated' "
            "(stable-baselines3: handle_timeout_termination)",
        )
    if card.lost:
        yield (
            "no-next-obs",
            "without 'next_obs' the last row of each episode is left out, and with it "
            f"{card.lost:,} terminations: record 'next_obs'",
        )


def _order_fault(card: Card) -> str:
    """Where rows are not in the order of collection, with the likely causes; empty if they are."""
    facts, causes = [], []
    if card.breaks:
        facts.append(f"{card.breaks:,} of {card.rows:,} rows break off without an end")
        if card.stride:
            causes.append(f"{card.stride} environments interleaved: give one after the other, with "
                          "the step as 'policy_version'")  # fmt: skip
        elif card.breaks > UNORDERED * card.rows:
            causes.append("shuffled rows: give them in the order of collection")
        else:
            causes.append("time limits that are not in 'truncated', or a ring buffer not read from "
                          "its oldest row")  # fmt: skip
    if card.joined > max(1, 0.1 * (card.episodes - 1)):
        facts.append(f"after {card.joined:,} ends the next row goes on where the episode ended")
        causes.append("the reset's row of next-step autoreset (leave it out), or next_obs taken "
                      "from the next episode (keep the last observation)")  # fmt: skip
    return f"{' and '.join(facts)}: {'; '.join(causes)}" if facts else ""


def _task_notices(card: Card) -> Iterator[Notice]:
    missed, invented = card.missed or 0, card.invented or 0
    if missed > 0.1 * card.terminations or invented > 1 + 1e-3 * card.rows:
        yield (
            "rule",
            f"the termination rule {card.rule} contradicts the recorded ends: it misses "
            f"{missed:,} of {card.terminations:,} terminations and would end {invented:,} of "
            f"{card.rows - card.terminations:,} other rows: another task's data, or a rule that is "
            "wrong (inverted, too tight, in other units); `--termination learnt` learns it from "
            "the data",
        )
    scaled = _unit_actions(card.action, card, 0.98)
    if scaled.any():
        yield (
            "action-range",
            f"the recorded actions of {dimension_list(scaled)} fill [-1, 1] and no more, where "
            f"{card.task} takes {_bounds(card)}: actions of a library that scales them; write them "
            "in the task's own units",
        )


def _policy_notices(card: Card) -> Iterator[Notice]:
    if card.policy is None:
        return
    policy, own = card.policy, card.policy.own
    low, high = policy.log_std or (0.0, 0.0)
    if policy.drawn:
        yield (
            "policy-spread",
            "the policy's first output differs at each call, so it is an action, not a mean: "
            "it is taken as the action, without the second (a log probability or a value?); let it "
            "return (mean, log_std) before the tanh, or actions only",
        )
    elif low > 0 or high > 5 or low < -20.5:
        yield (
            "policy-spread",
            f"the policy's second output, read as log_std, lies in {short(low)} to {short(high)}, "
            f"which makes actions spread by {policy.spread:.2f} of [-1, 1]: a standard deviation, "
            "a log probability or a value? Let it return (mean, log_std), or actions only",
        )
    acts = policy.log_std is None or policy.drawn
    if policy.beyond > 0.5 or (acts and _unit_actions(own, card, 0.9).any()):
        span = f"{short(float(own.low.min()))} to {short(float(own.high.max()))}"
        yield (
            "policy-range",
            f"the policy's actions lie in {span}, where {card.task} takes {_bounds(card)}: of "
            "another scale? Return them in the task's own units",
        )


def _unit_actions(own: Range, card: Card, reach: float) -> NDArray[np.bool_]:
    """Which actions keep to [-1, 1], up to its ends (`reach`), where the bounds are wider."""
    if card.bounds is None:
        return np.zeros(len(own.low), bool)
    low, high = card.bounds
    wider, inside = (low < -1.5) | (high > 1.5), own.largest <= 1 + 1e-5
    return wider & inside & (own.largest >= reach) & (inside | ~wider).all()


def _bounds(card: Card) -> str:
    assert card.bounds is not None
    low, high = card.bounds
    return f"{short(float(low.min()))} to {short(float(high.max()))}"


def dimension_list(which: NDArray[np.bool_]) -> str:
    """Some dimensions by their numbers, eight at most."""
    numbers = np.flatnonzero(which).tolist()
    shown = ", ".join(map(str, numbers[:8])) + (", ..." if len(numbers) > 8 else "")
    return f"dimension {shown}" if len(numbers) == 1 else f"dimensions {shown}"


def sentence(card: Mapping[str, Any]) -> str:
    """The facts of a described card in one line; empty for none."""
    if not card:
        return ""
    low, high = card["reward"]["low"][0], card["reward"]["high"][0]
    returned = (card.get("policy") or {}).get("return")
    return (
        f"{card['rows']:,} rows, {card['episodes']:,} episodes: {card['terminations']:,} "
        f"terminations, {card['truncations']:,} truncations, {card['breaks']:,} breaks without an "
        f"end; rewards {short(low)} to {short(high)}"
        + ("" if returned is None else f"; the policy's return {short(returned)}")
    )
