"""The verdicts of studies on the paper's claims, in sentences: agreement and differences."""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from tom.analysis.progression import DECILES, LATE
from tom.studies.progression import RISE, Finding
from tom.studies.road import TOM_SUCCESS_MIN, Outcome

SIMPLER = ("expert-only", "footprint-only", "ratio", "pmac, expert last")
"""simple weightings of road-and-rocks, without a dual"""
PAPER = "paper, 1 sampled a'"
"""the variant with the paper's networks and steps"""


def road(outcomes: Sequence[Outcome], sweep: Sequence[Outcome]) -> list[str]:
    """Whether TOM beats MLE and weighs the road, what else does so, and where MLE is enough."""
    tom, mle = _named(outcomes, "tom"), _named(outcomes, "mle")
    both = sorted(tom.keys() & mle.keys())
    better = sum(tom[seed].sac_return > mle[seed].sac_return for seed in both)
    heavier = sum(tom[seed].road_share > mle[seed].road_share for seed in both)
    lines = [
        f"TOM's return is above MLE's on {better} of {len(both)} seeds (median "
        f"{_median(tom, 'sac_return'):.1f} against {_median(mle, 'sac_return'):.1f}, success "
        f"{_median(tom, 'sac_success'):.2f} against {_median(mle, 'sac_success'):.2f}): "
        f"{_held(better, len(both))}",
        f"Its weight lies on the road on {heavier} of {len(both)} seeds more than MLE's (median "
        f"share {_median(tom, 'road_share'):.2f} against {_median(mle, 'road_share'):.2f}): "
        f"{_held(heavier, len(both))}",
    ]
    simpler = [
        name
        for name in SIMPLER
        if (of := _named(outcomes, name)) and _median(of, "sac_success") >= TOM_SUCCESS_MIN
    ]
    if simpler:
        lines.append(
            f"What the paper leaves out: {', '.join(simpler)} arrive as well, so the task does not "
            "show that TOM's dual is what helps."
        )
    turns = [turn for turn in sorted({o.turn for o in sweep}) if _mle_arrives(sweep, turn)]
    if turns:
        lines.append(
            "The paper does not say how much its rocks turn the steering: at "
            f"{', '.join(f'{turn:g}' for turn in turns)} degrees the planner arrives in MLE's "
            "model, too, and the claim does not hold."
        )
    return lines


def progression(findings: Sequence[Finding]) -> list[str]:
    """Whether TOM's weights are low on random data, rise, and rise before the end."""
    own = [f for f in findings if (f.condition, f.learner) == ("own", "tom")]
    low, rank, rise = (
        [f.median for f in own if f.quantity == name]
        for name in ("random half", "Spearman, ordered half", RISE)
    )
    said = [
        ("lie below the mean over the random half", [value < 1 for value in low], low),
        ("grow along SAC's half (rank correlation)", [value > 0 for value in rank], rank),
        (
            "are above the mean before its last fifth (first such tenth)",
            [value <= DECILES - LATE for value in rise],
            rise,
        ),
    ]
    return [
        f"TOM's weights {what} in {sum(holds)} of {len(holds)} recordings "
        f"({', '.join(f'{value:.3g}' for value in values)}): {_held(sum(holds), len(holds))}"
        for what, holds, values in said
        if holds
    ]


def tabular(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """How far the claim holds; `rows` are the summary of the variants."""
    judged = rows[0]
    lines = [f"The ratio is recovered as the paper says: {judged['variant']}, {_near(judged)}."]
    if judged["spearman"] < 0.95:
        lines = [f"The ratio is not recovered as claimed: {judged['variant']}, {_near(judged)}."]
    paper = next((row for row in rows if row["variant"] == PAPER), None)
    if paper:
        lines.append(
            "With the paper's networks and steps the weights come less near: "
            f"{PAPER}, {_near(paper)}."
        )
    return lines


def _near(row: Mapping[str, Any]) -> str:
    return f"rank correlation {row['spearman']:.2f}, relative L1 error {row['l1']:.2f} (medians)"


def _held(count: int, of: int) -> str:
    """The last sentence of a comparison with the paper."""
    if count == of:
        return "as the paper says."
    return "mostly as the paper says." if 2 * count > of else "the paper says otherwise."


def _named(outcomes: Sequence[Outcome], name: str) -> dict[int, Outcome]:
    return {o.seed: o for o in outcomes if o.name == name}


def _median(outcomes: Mapping[int, Outcome], quantity: str) -> float:
    return median(getattr(o, quantity) for o in outcomes.values())


def _mle_arrives(sweep: Sequence[Outcome], turn: float) -> bool:
    of = [o.planner_success for o in sweep if (o.name, o.turn) == ("mle", turn)]
    return bool(of) and median(of) >= TOM_SUCCESS_MIN
