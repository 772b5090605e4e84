"""The verdicts of studies on the paper's claims, in sentences: agreement and differences."""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from tom.analysis.progression import DECILES, LATE
from tom.analysis.settings import unlike
from tom.analysis.statistics import RANKED, remark
from tom.envs import task
from tom.studies.progression import RISE, Finding
from tom.studies.returns import PAPER_ENVS, Cell, cell_of, compared_at, envs_of
from tom.studies.road import TOM_SUCCESS_MIN, Outcome

SIMPLER = ("expert-only", "footprint-only", "ratio", "pmac, expert last")
"""simple weightings of road-and-rocks, without a dual"""
PAPER = "paper, 1 sampled a'"
"""the variant with the paper's networks and steps"""
NOTHING = (
    f"No environment of the paper has at least {RANKED} runs of TOM, of the first preset, and of "
    "another learner: nothing to compare with the claim."
)
NAMED = 3
"""runs named at most in a sentence"""


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


def returns(cells: Sequence[Cell]) -> list[str]:
    """In how many of the paper's environments TOM's mean is the highest, and the reservations."""
    return [*_ranking(cells), *_cut_short(cells), *_unlike(cells)]


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


def _ranking(cells: Sequence[Cell]) -> list[str]:
    """TOM's place among the groups that have enough runs to be ranked, and who has too few."""
    of_paper = [c for c in cells if c.env in PAPER_ENVS]
    enough = {
        env: [c for c in of_paper if c.env == env and c.n >= RANKED] for env in envs_of(of_paper)
    }
    judged = {
        env: group
        for env, group in enough.items()
        if cell_of(group, env, "tom") and any(c.learner != "tom" for c in group)
    }
    lines = _places(judged, compared_at(cells)) if judged else [NOTHING]
    if few := [c for c in of_paper if c.n < RANKED]:
        said = [
            f"{env}: {', '.join(f'{c.label} (n = {c.n})' for c in few if c.env == env)}"
            for env in envs_of(few)
        ]
        lines.append(f"Not ranked, with fewer than {RANKED} runs: {'; '.join(said)}.")
    return lines


def _places(judged: Mapping[str, Sequence[Cell]], at: Mapping[str, float]) -> list[str]:
    """Where TOM and its variants have the highest mean, and what is to be kept in mind."""
    first = [env for env, group in judged.items() if _tom_is_first(group, at[env])]
    lines = [
        f"TOM has the highest mean in {len(first)} of {len(judged)} of the paper's environments"
        f"{_listed(first)}; the paper says 4 of 5."
    ]
    every = [c for group in judged.values() for c in group]
    variants = sorted({c.variant for c in every if c.learner == "tom" and c.variant})
    for variant in variants:
        have = [env for env, group in judged.items() if cell_of(group, env, "tom", variant)]
        first = [env for env in have if _tom_is_first(judged[env], at[env], variant)]
        lines += [f"TOM, {variant}, has it in {len(first)} of {len(have)}{_listed(first)}."]
    if len(variants) > 1:
        lines.append("TOM's variants are held against the other learners, not against each other.")
    if said := remark([c.n for c in every]):
        lines.append(f"The smallest group: {said}.")
    short = [
        f"{env} {at[env]:.0f} of {task(env).steps}" for env in judged if at[env] < task(env).steps
    ]
    if short:
        lines.append(f"Compared before the end of the paper's training: {'; '.join(short)} steps.")
    return lines


def _listed(envs: Sequence[str]) -> str:
    return f" ({', '.join(envs)})" if envs else ""


def _tom_is_first(cells: Sequence[Cell], step: float, variant: str = "") -> bool:
    """Whether this TOM has the highest mean best return; its other variants are no rivals."""
    means = {cell.method: float(cell.scores(step).mean()) for cell in cells}
    tom = means["tom", variant]
    return all(tom > mean for (learner, _), mean in means.items() if learner != "tom")


def _cut_short(cells: Sequence[Cell]) -> list[str]:
    """One line per environment in which some runs go on after others ended, the shortest named."""
    lines = []
    for env, step in compared_at(cells).items():
        here = [c for c in cells if c.env == env]
        longest = max(cell.longest for cell in here)
        if longest > step:
            ended = [
                f"{run.run_id} ({run.status.shown})"
                for cell in here
                for run, curve in zip(cell.runs, cell.curves, strict=True)
                if curve.step[-1] == step
            ]
            more = f" and {len(ended) - NAMED} more" if len(ended) > NAMED else ""
            lines.append(
                f"{env}: compared at step {step:.0f} of {longest:.0f}, the last evaluation of "
                f"{', '.join(ended[:NAMED])}{more}."
            )
    return lines


def _unlike(cells: Sequence[Cell]) -> list[str]:
    """One line per environment whose learners were trained with different settings."""
    lines = []
    for env in envs_of(cells):
        paths = unlike([run for c in cells if c.env == env for run in c.runs])
        if paths:
            lines.append(
                f"{env}: the learners' runs differ in more than learner, seed and steps "
                f"({', '.join(paths)}), so returns may differ by these settings."
            )
    return lines
