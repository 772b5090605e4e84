"""Colours can be told apart and read."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from app.figures.curves import styles_of
from app.theme import (
    ACCENT,
    BACKGROUND,
    COLUMNS,
    LEARNER_COLOURS,
    LINK,
    NEUTRAL,
    QUALITATIVE,
    SURFACE,
    TEXT,
    Mode,
    contrast,
    learner_colour,
    linear_light,
    ramp,
    rgb,
    scale_colours,
)
from tom.analysis.settings import Kind
from tom.learners import LEARNERS, learner_label

# Machado, Oliveira and Fernandes (2009), severity 1.
VISION = {
    "normal": np.eye(3),
    "red-blind": np.array(
        [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]]
    ),
    "green-blind": np.array(
        [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]]
    ),
    "blue-blind": np.array(
        [[1.2555, -0.0767, -0.1788], [-0.0784, 0.9308, 0.1476], [0.0047, 0.6914, 0.3039]]
    ),
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(intensity: np.ndarray) -> np.ndarray:
    white = np.array([0.9505, 1.0, 1.089])
    share = np.cbrt(np.maximum(TO_XYZ @ np.clip(intensity, 0, 1) / white, 0.008856))
    x, y, z = share
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def test_a_newcomer_in_the_registry_gets_a_spare_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = replace(LEARNERS["mle"], colour=None)
    monkeypatch.setitem(LEARNERS, "first", entry)
    monkeypatch.setitem(LEARNERS, "second", entry)
    assert learner_colour("first") != learner_colour("second")
    assert learner_colour("first") not in LEARNER_COLOURS.values()


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_learners_groups_and_points_stand_out_from_the_page(mode: Mode) -> None:
    along = scale_colours(np.linspace(0, 1, 101), COLUMNS[mode])
    points = ["#" + bytes(map(int, colour)).hex() for colour in along]
    variants = [Kind(learner, "", f"model.hidden {n}") for learner in LEARNERS for n in range(40)]
    shades = [look.colour for look in styles_of(("hopper", kind) for kind in variants).values()]
    for colours, least in (
        (LEARNER_COLOURS.values(), 3.0), (QUALITATIVE, 3.0), (points, 3.0), (ramp(7, mode), 2.8),
        (shades, 3.0),
    ):  # fmt: skip
        assert min(contrast(colour, BACKGROUND[mode]) for colour in colours) >= least


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize(
    ("colours", "least"),
    [
        (tuple(LEARNER_COLOURS.values()), 14),
        ((*QUALITATIVE, NEUTRAL), 20),
        *((tuple(colour for _, colour in COLUMNS[mode]), 14) for mode in BACKGROUND),
    ],
)
def test_colours_differ_for_every_eye(colours: tuple[str, ...], least: float, vision: str) -> None:
    seen = [lab(VISION[vision] @ linear_light(rgb(colour))) for colour in colours]
    assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) >= least


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("mode", ["light", "dark"])
def test_an_ordered_scale_gets_lighter_for_every_eye(mode: Mode, vision: str) -> None:
    lightness = [lab(VISION[vision] @ linear_light(rgb(colour)))[0] for colour in ramp(7, mode)]
    assert (np.diff(lightness) > 3).all()


def test_a_group_s_look_is_the_same_whatever_is_shown_beside_it() -> None:
    settings = ("", "model.hidden 8", "model.hidden 16")
    kinds = [
        Kind(learner, preset, variant)
        for learner in ("tom", "mle", "pmac")
        for preset in ("paper", "mended", "smoke")
        for variant in settings
    ]
    looks = styles_of(("hopper", kind) for kind in kinds)
    assert {look.dash for look in looks.values()} == {"solid"}
    for kind, look in looks.items():
        for beside in ([kind], [kinds[-1], kind], [k for k in kinds if k.preset == kind.preset]):
            again = styles_of(("hopper", one) for one in beside)[kind]
            assert (again.colour, again.core) == (look.colour, look.core)
            assert again.symbol == look.symbol
    for learner in ("tom", "mle", "pmac"):
        of_learner = {kind: look for kind, look in looks.items() if kind.learner == learner}
        drawn = {(look.colour, look.core) for look in of_learner.values()}
        assert len(drawn) == len(of_learner)


@pytest.mark.parametrize("vision", VISION)
def test_tom_as_printed_is_told_from_all_main_groups_by_every_eye(vision: str) -> None:
    kind = Kind("tom", "paper", "")
    core = lab(VISION[vision] @ linear_light(rgb(styles_of([("hopper", kind)])[kind].core)))
    others = [
        lab(VISION[vision] @ linear_light(rgb(colour))) for colour in LEARNER_COLOURS.values()
    ]
    assert min(np.linalg.norm(core - other) for other in others) >= 14


def test_an_unknown_learner_is_neutral_and_keeps_its_name() -> None:
    assert learner_colour("mine") == NEUTRAL
    assert NEUTRAL not in LEARNER_COLOURS.values()
    assert learner_label("mine") == "mine"


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_words_and_links_can_be_read(mode: Mode) -> None:
    behind = (BACKGROUND[mode], SURFACE[mode])
    assert min(contrast(words[mode], page) for words in (TEXT, LINK) for page in behind) >= 4.5
    assert contrast("#ffffff", ACCENT[mode]) >= 4.5  # on buttons
