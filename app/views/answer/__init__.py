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
from app.views.answer import numbers
from tom.analysis import answer, curves
from tom.analysis.answer import QUESTIONS, Contrast, Side, newest_share
from tom.analysis.curves import Curve, Group
from tom.analysis.grouping import has_uniform_learner, usual_other
from tom.analysis.weight_readers import first_weight_reader
from tom.envs import ROAD
from tom.learners import learner_label
from tom.record.reader import RunReader

HEIGHT, MAP_HEIGHT = 230, 280
SIGNS = {"yes": ":material/check_circle:", "no": ":material/cancel:",
         "unclear": ":material/help:", "unknown": ":material/hourglass_empty:"}  # fmt: skip
CARDS = (
    ("attention", "share of the weight on the newest fifth, %", 20.0),
    ("attention", "distance left, %: 0 is the policy", 100.0),
    ("curves", "return", None),
)
"""of the three cards: the page behind, what is drawn, and the level without weights"""
ON_ROAD = ("attention", "weight on the map, of one run", None)
"""the first card of road-and-rocks"""


Chart = tuple[FigureJson, str]
"""of a card, and the caption of its saved figure"""


def page(scope: Scope) -> None:
    """The trainings that run; one group of runs against another, in three cards."""
    start.draw()
    groups = scope.comparable(scope.chosen_id)
    if not groups:
        st.info("No shown run learns a model: show others at the left, or start a training.")
        return
    titles = list(groups)
    head = st.columns([3, 3, 4], vertical_alignment="bottom")
    one = address.choose_one(
        head[0].selectbox, "Does it help to weigh by", titles, "one", titles[0]
    )
    both = {one: groups[one]}
    if usual := usual_other(groups, one):
        others = [title for title in titles if title != one]
        other = address.choose_one(head[1].selectbox, "instead of", others, "other", usual)
        both[other] = groups[other]
    env = groups[one][0].env
    heading = text.markdown(
        f"{task_title(env)}: does {one} look at the right data, and does that help?"
    )
    st.header(heading, anchor=False)
    _cards(scope, both)
    if env != ROAD:  # which has no exams
        behind = address.fold("The numbers behind it", "numbers")
        if behind.open:
            with behind:
                numbers.draw(scope, env)


def _cards(scope: Scope, groups: Mapping[str, Sequence[RunReader]]) -> None:
    """The three cards. Only their charts are kept: all else is quick, once its files are read."""
    sides = [
        answer.side_of(title, runs, readers.metrics, readers.profiles, _contrast, text.markdown)
        for title, runs in groups.items()
    ]
    mine, every = next(iter(groups.values())), [run for runs in groups.values() for run in runs]
    styles = frozenset(
        (kind, scope.styles[kind]) for kind in {scope.kinds[r.run_id] for r in every}
    )
    version = tuple(
        (
            run.status.alive, readers.metrics_version(run),
            first_weight_reader(run).version("profiles"),
        )
        for run in every
    )  # fmt: skip
    drawn = get_or_make(
        ("cards", *groups, styles, *(run.path for run in every)), version,
        lambda: _charts(scope, groups, sides),
    )  # fmt: skip
    cards = CARDS
    if sides[0].env == ROAD:
        cards = ON_ROAD, *CARDS[1:]
        drawn = [None if sides[0].uniform else _map(mine), *drawn[1:]]
    one, other = sides[0], sides[1] if len(sides) > 1 else None
    grid = st.container(horizontal=True, key="cards")
    for question, (link, what, _), answered, chart_of in zip(
        QUESTIONS, cards, answer.answers(one, other), drawn, strict=True
    ):
        with grid, st.container(border=True, height="stretch"):
            st.subheader(question, anchor=False)
            st.markdown(f"#### {SIGNS[answered.word]} {text.markdown(answered.verdict)}")
            if chart_of is not None:
                st.caption(what)
                figure, caption = chart_of
                chart(figure, f"answer {question}", f"{question} {what}", caption=caption)
            st.markdown(text.with_glossary_links(text.unbroken(answered.sentence)))
            if answered.more:
                st.caption(text.with_glossary_links(text.unbroken(answered.more)))
            widgets.link_to(link, f"See it on {link.capitalize()}", run=mine[0].run_id)


def _charts(
    scope: Scope, groups: Mapping[str, Sequence[RunReader]], sides: Sequence[Side]
) -> list[Chart | None]:
    """The charts of the three cards: newest fifth, footprint, return."""
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
    return [
        _chart(scope, what, level, curves.groups(lines, answer.MIDDLE))
        for (_, what, level), lines in zip(CARDS, measured, strict=True)
    ]


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
        "interquartile mean over runs, band: 95 % bootstrap interval, thin lines: single runs. "
        f"{named}."
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


@cached("buffer", "snapshot", "profiles")
def _contrast(run: RunReader, step: int) -> Contrast | None:
    return answer.contrast(readers.fresh_reader(run), step)
