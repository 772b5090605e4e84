"""Answer: where a learner looks, whether that is where its policy goes, and whether it helps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import streamlit as st

from app import glossary, session, text
from app.data import answer, buffer, readers
from app.data.answer import Answer, Contrast, Side, newest_share
from app.data.cache import VersionedCache
from app.data.called import task
from app.data.exams import exams_of
from app.figures.base import across
from app.figures.curves import Look, group_curves
from app.parts import address, trainings_strip, widgets
from app.parts.plot import Drawn, Follow, chart
from app.parts.scope import Scope
from app.theme import learner_label
from app.views.answer import exams, model_error
from tom.analysis import curves
from tom.analysis.curves import Curve, Group
from tom.analysis.scores import counted_from
from tom.analysis.settings import Kind
from tom.config import SAC_ALONE
from tom.envs import ROAD
from tom.learners import LEARNERS
from tom.record.reader import RunReader

REFRESH_S = 5
HEIGHT = 230
SIGNS = {"yes": ":material/check_circle:", "no": ":material/cancel:",
         "unclear": ":material/help:", "unknown": ":material/hourglass_empty:"}  # fmt: skip
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
    trainings_strip.draw()
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
    cards = st.fragment(_cards, run_every=REFRESH_S if alive else None)
    cards(scope, {title: groups[title] for title in (one, other) if title})
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
    for column, question, card in zip(st.columns(3), QUESTIONS, made, strict=True):
        with column, st.container(border=True, height="stretch"):
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
    shares = [] if on_road else _share_curves(scope, fresh)
    newest, footprint = (
        "share of the weight on the newest fifth, %",
        "footprint: 1 is no nearer, 0 the policy",
    )
    looks = scope.looks
    return [
        Card(where, "attention", newest, *_drawn(shares, newest, looks, 20.0)),
        Card(
            on_policy,
            "attention",
            footprint,
            *_drawn(_footprints(scope, fresh, sides), footprint, looks, 1.0),
        ),
        Card(helps, "curves", "return", *_drawn(_returns(scope, fresh), "return", looks)),
    ]


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


def _drawn(
    groups: Sequence[Group], what: str, looks: Mapping[Kind, Look], level: float | None = None
) -> tuple[Drawn | None, str]:
    """The chart of a card, with a line at `level`, and the caption of a saved figure."""
    if not groups:
        return None, ""
    figure = group_curves(groups, what, HEIGHT, singles=True, looks=looks)
    figure.update_layout(showlegend=False, hovermode="closest")
    if level is not None:
        figure.add_shape(across(level, 1.2, "dash"))
    named = ", ".join(f"{looks[group.kind].title} (n = {group.n})" for group in groups)
    return Drawn.of(figure), (
        f"{what.capitalize()}, against env steps. Line: mean over seeds, band: 95 % bootstrap "
        f"interval, thin lines: single runs. {named}."
    )


def _side(title: str, runs: Sequence[RunReader]) -> Side:
    loops, runs = runs, [readers.weighed(run) for run in runs]
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
        _contrast(runs),
    )


def _contrast(runs: Sequence[RunReader]) -> Contrast | None:
    """That of the last kept fit of the first run that keeps its buffer."""
    found = (
        answer.contrast(run, run.snapshot_steps()[-1])
        for run in runs
        if run.snapshot_steps() and buffer.has_rows(run) and not _uniform(run)
    )
    return next(filter(None, found), None)


def _grouped(scope: Scope, made: Sequence[tuple[RunReader, np.ndarray, np.ndarray]]) -> list[Group]:
    drawn = [
        Curve(run.run_id, run.env, run.learner, run.preset, run.seed, step, value,
              scope.kinds[run.run_id].variant, scope.kinds[run.run_id])
        for run, step, value in made
    ]  # fmt: skip
    return curves.groups(drawn)


def _share_curves(scope: Scope, groups: Mapping[str, Sequence[RunReader]]) -> list[Group]:
    runs = [run for of in groups.values() for run in of if not _uniform(run)]
    found = [(run, readers.profiles(readers.weighed(run))) for run in runs]
    return _grouped(
        scope, [(r, p.env_step, 100 * newest_share(p)) for r, p in found if len(p.env_step)]
    )


def _footprints(
    scope: Scope, groups: Mapping[str, Sequence[RunReader]], sides: Sequence[Side]
) -> list[Group]:
    made = []
    for side, runs in zip(sides, groups.values(), strict=True):
        if side.uniform:
            continue
        for run, of_run in zip(runs, side.exams, strict=True):
            here = of_run.telling & np.isfinite(of_run.footprint)
            made.append((run, of_run.step[here], of_run.footprint[here]))
    return _grouped(scope, made)


def _returns(scope: Scope, groups: Mapping[str, Sequence[RunReader]]) -> list[Group]:
    runs = [run for of in groups.values() for run in of]
    of_runs = [(run, widgets.curve(run, "eval/return")) for run in runs]
    return _grouped(scope, [(run, curve.step, curve.value) for run, curve in of_runs])
