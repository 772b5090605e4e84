"""Answer: where a learner looks, whether that is where its policy goes, and whether it helps."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import streamlit as st

from app import session, text
from app.data import buffer, readers, road
from app.data.cache import cached, get_or_make
from app.data.run_names import task_title
from app.figures.base import horizontal_line, step_axis_title
from app.figures.curves import group_curves
from app.figures.road import road_map
from app.parts import address, start, widgets
from app.parts.plot import FigureJson, chart
from app.parts.scope import Scope
from app.parts.widgets import has_uniform_learner
from app.theme import learner_label
from app.views.answer import numbers
from tom.analysis import answer, curves
from tom.analysis.answer import Answer, Contrast, Side, newest_share
from tom.analysis.curves import Curve, Group
from tom.analysis.exams import exams_of
from tom.analysis.scores import counted_from
from tom.config import SAC_ALONE
from tom.envs import ROAD
from tom.record.reader import RunReader

HEIGHT, MAP_HEIGHT = 230, 280
SIGNS = {"yes": ":material/check_circle:", "no": ":material/cancel:",
         "unclear": ":material/help:", "unknown": ":material/hourglass_empty:"}  # fmt: skip
CARDS = (
    ("Where does it look?", "attention", "share of the weight on the newest fifth, %", 20.0),
    ("Is that where the policy goes?", "attention", "distance left, %: 0 is the policy", 100.0),
    ("Does it help?", "curves", "return", None),
)
"""the three cards: question, page behind, what is drawn, and the level without weights"""
ON_ROAD = ("Where does it look?", "attention", "weight on the map, of one run", None)
"""the first card of road-and-rocks"""


Chart = tuple[FigureJson, str]
"""of a card, and the caption of its saved figure"""
Card = tuple[Answer, Chart | None]


def page(scope: Scope) -> None:
    """The trainings that run; one group of runs against another, in three cards."""
    start.draw()
    groups = _groups(scope)
    if not groups:
        st.info("No run of this task learns a model yet: choose another task, or start a training.")
        return
    titles = list(groups)
    head = st.columns([3, 3, 4], vertical_alignment="bottom")
    one = address.choose_one(
        head[0].selectbox, "Does it help to weigh by", titles, "one", titles[0]
    )
    both = {one: groups[one]}
    others = [title for title in titles if title != one]
    if others:
        usual = next((t for t in others if has_uniform_learner(groups[t][0])), others[0])
        other = address.choose_one(head[1].selectbox, "instead of", others, "other", usual)
        both[other] = groups[other]
    env = groups[one][0].env
    heading = text.markdown(
        f"{task_title(env)}: does {one} look at the right data, and does that help?"
    )
    st.header(heading, anchor=False)
    _cards(scope, both)
    if env != ROAD:  # which has no exams
        behind = st.expander("The numbers behind it", key="numbers behind", on_change="rerun")
        if behind.open:
            with behind:
                numbers.draw(scope, env)


def _groups(scope: Scope) -> dict[str, list[RunReader]]:
    """The shown runs of one task that fit a model, by their group's title: weighing ones first."""
    runs = [run for run in scope.shown if run.learner != SAC_ALONE] or [
        run for run in scope.counted if run.learner != SAC_ALONE
    ]
    asked = [run for run in runs if run.run_id == scope.chosen_id]
    groups: dict[str, list[RunReader]] = {}
    for run in runs:
        if run.env == (asked or runs)[0].env:
            groups.setdefault(scope.title(run), []).append(run)
    chosen = scope.title(asked[0]) if asked else ""
    order = sorted(
        (title for title in scope.order if title in groups),
        key=lambda title: (title != chosen, has_uniform_learner(groups[title][0])),
    )
    return {title: groups[title] for title in order}


def _cards(scope: Scope, groups: Mapping[str, Sequence[RunReader]]) -> None:
    kinds = {scope.kinds[run.run_id] for runs in groups.values() for run in runs}
    # A fit that keeps its buffer has a profile as well.
    version = tuple(
        (run.path, run.version("facts"), run.version("metrics"), run.version("profiles"))
        for runs in groups.values()
        for loop in runs
        for run in dict.fromkeys((loop, readers.first_weight_reader(loop)))
    )
    key = tuple(groups), session.mode(), frozenset((kind, scope.styles[kind]) for kind in kinds)
    made = get_or_make(("cards", *key), version, lambda: _make_cards(scope, groups))
    grid = st.container(horizontal=True, key="cards")
    mine = next(iter(groups.values()))
    cards = (ON_ROAD, *CARDS[1:]) if mine[0].env == ROAD else CARDS
    for (question, link, what, _), (answered, drawn) in zip(cards, made, strict=True):
        with grid, st.container(border=True, height="stretch"):
            st.subheader(question, anchor=False)
            st.markdown(f"#### {SIGNS[answered.word]} {text.markdown(answered.verdict)}")
            if drawn is not None:
                st.caption(what)
                figure, caption = drawn
                chart(figure, f"answer {question}", f"{question} {what}", caption=caption)
            st.markdown(text.with_glossary_links(text.unbroken(answered.sentence)))
            if answered.more:
                st.caption(text.with_glossary_links(text.unbroken(answered.more)))
            widgets.link_to(link, f"See it on {link.capitalize()}", run=mine[0].run_id)


def _make_cards(scope: Scope, groups: Mapping[str, Sequence[RunReader]]) -> list[Card]:
    sides = [_side(title, runs) for title, runs in groups.items()]
    measured = zip(CARDS, _chart_groups(scope, groups, sides), strict=True)
    drawn = [_chart(scope, what, level, lines) for (_, _, what, level), lines in measured]
    mine = next(iter(groups.values()))
    if mine[0].env == ROAD and not sides[0].uniform:
        drawn[0] = _map(mine)
    return list(zip(_answers(sides, mine), drawn, strict=True))


def _answers(sides: Sequence[Side], mine: Sequence[RunReader]) -> tuple[Answer, Answer, Answer]:
    """The answers to the three questions; `mine` are the runs of the first side."""
    one = sides[0]
    where, on_policy = answer.where(one), answer.on_policy(one)
    if mine[0].env == ROAD:
        if not one.uniform:
            where = answer.on_road(one.name, [readers.metrics(run) for run in mine])
        on_policy = Answer(
            "unknown", "Not asked here",
            "Road-and-rocks learns from a fixed data set: nothing is collected after a fit. "
            "Attention shows the weights on the map.",
        )  # fmt: skip
    if any(readers.first_weight_reader(run) is not run for run in mine):
        helps = Answer(
            "unknown", "Not asked here", "Live weights are computed alongside a training loop, "
            "which does not learn from them.", "`run.latest_weights()` would give them to it.",
        )  # fmt: skip
    elif len(sides) > 1:
        helps = answer.helps(one, sides[1])
    else:
        helps = Answer(
            "unknown", "Cannot be told yet", "There is nothing to compare it with.",
            "Train MLE, which weighs every row the same.",
        )  # fmt: skip
    return where, on_policy, helps


def _chart_groups(
    scope: Scope, groups: Mapping[str, Sequence[RunReader]], sides: Sequence[Side]
) -> list[list[Group]]:
    """The groups of the three charts: newest fifth, footprint, return."""
    measured: list[list[Curve]] = [[], [], []]
    for side, runs in zip(sides, groups.values(), strict=True):
        for run, profiles, returns, exams in zip(
            runs, side.profiles, side.returns, side.exams, strict=True
        ):
            kind = scope.kinds[run.run_id]
            returns = replace(returns, variant=kind.variant, group=kind)
            measured[2].append(returns)
            if run.env != ROAD and not has_uniform_learner(run):
                share = 100 * newest_share(profiles)
                measured[0].append(replace(returns, step=profiles.env_step, value=share))
            if not side.uniform:
                informative = exams.subset(exams.informative & np.isfinite(exams.footprint))
                left = 100 * informative.footprint
                measured[1].append(replace(returns, step=informative.step, value=left))
    return [curves.groups(one) for one in measured]


def _chart(scope: Scope, what: str, level: float | None, groups: Sequence[Group]) -> Chart | None:
    """The chart of a card, with a line at a level; None without anything to draw."""
    if not groups:
        return None
    figure = group_curves(groups, what, HEIGHT, singles=True, styles=scope.styles)
    figure.update_layout(showlegend=False, hovermode="closest")
    if level is not None:
        figure.add_shape(horizontal_line(level, 1.2, "dash"))
    named = ", ".join(f"{scope.styles[group.kind].title} (n = {group.n})" for group in groups)
    caption = (
        f"{what.capitalize()}, against {step_axis_title(group.env for group in groups)}. Line: "
        f"mean over seeds, band: 95 % bootstrap interval, thin lines: single runs. {named}."
    )
    return FigureJson.of(figure), caption


def _map(runs: Sequence[RunReader]) -> Chart | None:
    """Road and rocks with the weights of the first run that has them; None if none has."""
    kept = (run for run in runs if buffer.has_rows(run))
    for run, picture in ((run, road.fit(run, run.status.env_step)) for run in kept):
        if picture is not None:
            figure = road_map(picture, session.mode(), MAP_HEIGHT).update_layout(showlegend=False)
            named = f"{learner_label(run.learner)}, seed {run.seed}, step {picture.step:,}"
            return FigureJson.of(figure), f"Mean weight in each part of the map: {named}."
    return None


def _side(title: str, loops: Sequence[RunReader]) -> Side:
    runs = [readers.first_weight_reader(run) for run in loops]
    seen = (
        _contrast(run, run.snapshot_steps()[-1])  # of the last kept fit
        for run in runs
        if run.snapshot_steps() and buffer.has_rows(run) and not has_uniform_learner(run)
    )
    frames = [readers.metrics(run) for run in runs]
    live = f" ({learner_label(runs[0].learner)}, live)" if runs[0] is not loops[0] else ""
    name = text.markdown(title + live)  # it stands in sentences
    return Side(
        name,
        all(map(has_uniform_learner, runs)),  # grouped by a setting, learners are mixed
        [readers.profiles(run) for run in runs],
        [widgets.curve(run, "eval/return") for run in loops],
        [
            exams_of(run.run_id, run.learner, run.seed, name, frame)
            for run, frame in zip(runs, frames, strict=True)
        ],
        counted_from(frames),
        next(filter(None, seen), None),
    )


@cached("buffer", "snapshot")
def _contrast(run: RunReader, step: int) -> Contrast | None:
    return answer.contrast(readers.fresh_reader(run), step)
