"""Answer: where a learner looks, whether that is where its policy goes, and whether it helps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import streamlit as st

from app import glossary, session, text
from app.data import answer, buffer, readers
from app.data.answer import Answer, Side, newest_share
from app.data.cache import VersionedCache
from app.data.called import task
from app.data.exams import exams_of
from app.figures.base import across
from app.figures.curves import group_curves
from app.parts import address, cards, widgets
from app.parts.plot import Drawn, Follow, chart
from app.parts.scope import Scope
from app.theme import learner_label
from app.views.answer import exams, model_error
from tom.analysis import curves
from tom.analysis.curves import Curve, Group
from tom.analysis.scores import counted_from
from tom.config import SAC_ALONE
from tom.envs import ROAD
from tom.learners import LEARNERS
from tom.record.reader import RunReader

REFRESH_S = 5
HEIGHT = 230
SIGNS = {"yes": ":material/check_circle:", "no": ":material/cancel:",
         "unclear": ":material/help:", "unknown": ":material/hourglass_empty:"}  # fmt: skip
CHARTS = (
    ("attention", "share of the weight on the newest fifth, %", 20.0),
    ("attention", "footprint: 1 is no nearer, 0 the policy", 1.0),
    ("curves", "return", None),
)
"""the charts of the three cards: the page behind, what is drawn, and the level without weights"""
QUESTIONS = ("Where does it look?", "Is that where the policy goes?", "Does it help?")


@dataclass(frozen=True)
class Card:
    """One of the three cards: its answer, the page behind it, and its chart of `what`."""

    answer: Answer
    link: str
    what: str
    figure: Drawn | None
    caption: str


_MADE: VersionedCache[list[Card]] = VersionedCache()


def page(scope: Scope) -> None:
    """The trainings that run; one group of runs against another, in three cards."""
    cards.draw()
    groups = _groups(scope)
    if not groups:
        st.info("No run of this task learns a model yet: choose another task, or start a training.")
        return
    titles = list(groups)
    head = st.columns([3, 3, 4], vertical_alignment="bottom")
    one = address.choose_one(head[0].selectbox, "Is it worth weighing by", titles, "one", titles[0])
    others = [title for title in titles if title != one]
    if others:
        usual = next((t for t in others if _uniform(groups[t][0])), others[0])
        other = address.choose_one(head[1].selectbox, "instead of", others, "other", usual)
    else:
        other = None
    env = groups[one][0].env
    asked = text.markdown(f"{task(env)}: does {one} look at the right data, and does that help?")
    st.header(asked, anchor=False)
    alive = any(run.status.alive for runs in groups.values() for run in runs)
    both = {title: groups[title] for title in (one, other) if title}
    st.fragment(_cards, run_every=REFRESH_S if alive else None)(scope, both)
    behind = st.expander("The numbers behind it", key="numbers behind", on_change="rerun")
    if behind.open and env != ROAD:
        with behind:
            _behind(scope, env)


def _behind(scope: Scope, env: str) -> None:
    """The exams of all runs of the task, and their models' errors on one buffer."""
    task_runs = [run for run in scope.runs if run.env == env]
    alone = [run for run in task_runs if run.learner == SAC_ALONE]
    alike, others = exams.of_like_length([run for run in task_runs if run not in alone])
    lengths = dict.fromkeys(run.status.env_step for run in others)
    of_length = {
        f"of another length ({steps:,} steps)": [r for r in others if r.status.env_step == steps]
        for steps in lengths
    }
    exams.show_left_out(task_runs, {**of_length, "it fits no model": alone})
    exams.draw(alike)
    st.subheader("In sample: on rows that the models were fitted to", anchor=False)
    st.caption(
        "A model can err little here and much where its policy goes next: only the exams above are "
        "out of sample."
    )
    run = scope.one(lambda run: run in alike and buffer.has_rows(run), widgets.telling)
    if run is not None:
        model_error.on_one_buffer(run, alike)
    model_error.recorded(alike)


def _groups(scope: Scope) -> dict[str, list[RunReader]]:
    """The shown runs of one task that fit a model, by their group's title: weighing ones first."""
    runs = [run for run in scope.shown if run.learner != SAC_ALONE] or [
        run for run in scope.members if run.learner != SAC_ALONE
    ]
    env = next((run.env for run in runs if run.run_id == scope.asked), runs[0].env if runs else "")
    groups: dict[str, list[RunReader]] = {}
    for run in runs:
        if run.env == env:
            groups.setdefault(scope.title(run), []).append(run)
    chosen = next((scope.title(run) for run in runs if run.run_id == scope.asked), "")
    order = sorted(
        (title for title in scope.order if title in groups),
        key=lambda title: (title != chosen, _uniform(groups[title][0])),
    )
    return {title: groups[title] for title in order}


def _uniform(run: RunReader) -> bool:
    return run.learner in LEARNERS and LEARNERS[run.learner].uniform


def _cards(scope: Scope, groups: Mapping[str, Sequence[RunReader]]) -> None:
    listed = {run.run_id: run for run in readers.listing(session.links().store).runs}
    fresh = {t: [listed.get(run.run_id, run) for run in runs] for t, runs in groups.items()}
    kinds = {scope.kinds[run.run_id] for runs in fresh.values() for run in runs}
    # A fit that keeps its buffer has a profile as well.
    version = tuple(
        (run.path, run.version("facts"), run.version("metrics"), run.version("profiles"))
        for runs in fresh.values()
        for loop in runs
        for run in dict.fromkeys((loop, readers.weighed(loop)))
    )
    key = tuple(fresh), frozenset((kind, scope.looks[kind]) for kind in kinds)
    made = _MADE.get(key, lambda: _cards_of(scope, fresh), version)
    grid = st.container(horizontal=True, key="cards")
    for question, card in zip(QUESTIONS, made, strict=True):
        with grid, st.container(border=True, height="stretch"):
            _card(question, card)


def _cards_of(scope: Scope, fresh: Mapping[str, Sequence[RunReader]]) -> list[Card]:
    sides = [_side(title, runs) for title, runs in fresh.items()]
    mine = next(iter(fresh.values()))
    one, on_road = sides[0], mine[0].env == ROAD
    where, on_policy = answer.where(one), answer.on_policy(one)
    if on_road:
        if not one.uniform:
            where = answer.on_road(one.name, [readers.metrics(run) for run in mine])
        on_policy = Answer(
            "unknown", "Not asked here",
            "Road-and-rocks learns from a fixed data set: nothing is collected after a fit. "
            "Attention shows the weights on the map.",
        )  # fmt: skip
    if any(readers.weighed(run) is not run for run in mine):
        helps = Answer(
            "unknown", "Not asked here", "Nothing learns from live weights: they are "
            "computed beside a training loop.", "`run.latest_weights()` gives them to it.",
        )  # fmt: skip
    elif len(sides) > 1:
        helps = answer.helps(one, sides[1])
    else:
        helps = Answer(
            "unknown", "Cannot be told yet", "There is nothing to compare it with.",
            "Train MLE, which weighs all rows alike.",
        )  # fmt: skip
    drawn = zip((where, on_policy, helps), CHARTS, _measured(scope, fresh, sides), strict=True)
    return [_card_of(scope, *one) for one in drawn]


def _measured(
    scope: Scope, fresh: Mapping[str, Sequence[RunReader]], sides: Sequence[Side]
) -> list[list[Group]]:
    """The groups of the three charts: newest fifth, footprint, return."""
    measured: list[list[Curve]] = [[], [], []]
    for side, runs in zip(sides, fresh.values(), strict=True):
        for run, profiles, returns, exams_of_run in zip(
            runs, side.profiles, side.returns, side.exams, strict=True
        ):
            kind = scope.kinds[run.run_id]
            returns = replace(returns, variant=kind.variant, group=kind)
            measured[2].append(returns)
            if run.env != ROAD and not _uniform(run):
                share = 100 * newest_share(profiles)
                measured[0].append(replace(returns, step=profiles.env_step, value=share))
            if not side.uniform:
                told = exams_of_run.at(exams_of_run.telling & np.isfinite(exams_of_run.footprint))
                measured[1].append(replace(returns, step=told.step, value=told.footprint))
    return [curves.groups(one) for one in measured]


def _card_of(
    scope: Scope, answered: Answer, drawn: tuple[str, str, float | None], groups: Sequence[Group]
) -> Card:
    """A card, whose chart has a line at a level, and the caption of the saved chart."""
    link, what, level = drawn
    if not groups:
        return Card(answered, link, what, None, "")
    figure = group_curves(groups, what, HEIGHT, singles=True, looks=scope.looks)
    figure.update_layout(showlegend=False, hovermode="closest")
    if level is not None:
        figure.add_shape(across(level, 1.2, "dash"))
    named = ", ".join(f"{scope.looks[group.kind].title} (n = {group.n})" for group in groups)
    caption = (
        f"{what.capitalize()}, against env steps. Line: mean over seeds, band: 95 % bootstrap "
        f"interval, thin lines: single runs. {named}."
    )
    return Card(answered, link, what, Drawn.of(figure), caption)


def _card(question: str, card: Card) -> None:
    st.subheader(question, anchor=False)
    st.markdown(f"#### {SIGNS[card.answer.word]} {text.markdown(card.answer.verdict)}")
    if card.figure is not None:
        st.caption(card.what)
        chart(
            card.figure,
            f"answer {question}",
            f"{card.what}, against env steps",
            follow=Follow(cursor=True),
            caption=card.caption,
        )
    st.markdown(glossary.linked(card.answer.sentence))
    if card.answer.more:
        st.caption(glossary.linked(card.answer.more))
    widgets.link_to(card.link, f"See it on {card.link.capitalize()}")


def _side(title: str, loops: Sequence[RunReader]) -> Side:
    runs = [readers.weighed(run) for run in loops]
    seen = (
        answer.contrast(run, run.snapshot_steps()[-1])  # of the last kept fit
        for run in runs
        if run.snapshot_steps() and buffer.has_rows(run) and not _uniform(run)
    )
    frames = [readers.metrics(run) for run in runs]
    live = f" ({learner_label(runs[0].learner)}, live)" if runs[0] is not loops[0] else ""
    name = text.markdown(title + live)  # it stands in sentences
    return Side(
        name,
        all(map(_uniform, runs)),  # grouped by a setting, learners are mixed
        tuple(run.seed for run in runs),
        [readers.profiles(run) for run in runs],
        [widgets.curve(run, "eval/return") for run in loops],
        [
            exams_of(run.run_id, run.learner, run.seed, name, frame)
            for run, frame in zip(runs, frames, strict=True)
        ],
        counted_from(frames),
        next(filter(None, seen), None),
    )
