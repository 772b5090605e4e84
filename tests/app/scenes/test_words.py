"""Words in a 3D scene: in the page's colours, and where they are read from."""

from collections.abc import Iterator

import numpy as np
import pytest
import viser
import viser.transforms

from app.scenes.colours import rgb
from app.scenes.words import PIXELS, add_words, extent, fix, painted
from app.servers.processes import free_port
from app.theme import BACKGROUND, TEXT, Mode


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    made = viser.ViserServer("127.0.0.1", free_port("127.0.0.1"), verbose=False)
    yield made
    made.stop()


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_words_have_the_themes_colours_and_no_box(mode: Mode) -> None:
    image = painted("TOM, fit of step 3,000", mode)
    clear = np.equal(image[..., 3], 0)
    assert clear[[0, -1]].all()
    assert clear.mean() > 0.3
    letters = image[np.equal(image[..., 3], 255)]
    assert np.equal(letters, [*rgb(TEXT[mode]), 255]).all(1).mean() > 0.5
    halo = np.array(rgb(BACKGROUND[mode]))
    assert (np.abs(image[~clear, :3].astype(int) - halo) < 3).all(1).mean() > 0.2


def test_no_letter_is_cut_off() -> None:
    image = painted("Äjgq|", "dark")
    edges = (image[0], image[-1], image[:, 0], image[:, -1])
    assert all((edge[:, 3] == 0).all() for edge in edges)


def test_words_stand_on_their_foot(server: viser.ViserServer) -> None:
    across, high = extent("goal", "light", 0.1)
    assert across / high == pytest.approx(np.divide(*painted("goal", "light").shape[1::-1]))
    assert high > 0.1 * (painted("goal", "light").shape[0] - 20) / PIXELS
    standing = add_words(server.scene, "/a", "goal", "light", (1.0, 2.0, 3.0), 0.1, np.pi / 2).node
    assert standing.position == pytest.approx([1.0, 2.0, 3.0 + high / 2])
    # The picture's last axis to the letters' top is its own y, which now points up.
    turn = viser.transforms.SO3(standing.wxyz)
    assert turn.apply(np.array([0.0, 1.0, 0.0])) == pytest.approx([0.0, 0.0, 1.0])
    lying = add_words(server.scene, "/b", "goal", "light", (1.0, 2.0, 3.0), 0.1, 0.0).node
    assert lying.position == pytest.approx([1.0, 2.0 + high / 2, 3.0])
    assert (standing.render_width, standing.render_height) == (across, high)


@pytest.mark.parametrize("tilt", [0.0, 0.7, np.pi / 2])
def test_words_are_never_seen_from_behind(server: viser.ViserServer, tilt: float) -> None:
    foot = (0.5, 1.0, 0.02)
    words = add_words(server.scene, "/turning", "TOM s0", "dark", foot, 0.05, tilt)
    draws = np.random.default_rng(0)
    for camera in foot + 3 * draws.normal(size=(100, 3)):
        words.face(camera)
        turn = viser.transforms.SO3(words.node.wxyz)
        front = turn.apply(np.array([0.0, 0.0, 1.0]))
        assert front @ (camera - foot) > 0
        assert turn.apply(np.array([0.0, 1.0, 0.0]))[2] >= -1e-9  # and never upside down
        lower = words.node.position - words.node.render_height / 2 * turn.apply(
            np.array([0.0, 1.0, 0.0])
        )
        assert lower == pytest.approx(np.array(foot))


@pytest.mark.parametrize("tilt", [0.0, 0.7, np.pi / 2])
def test_words_that_nobody_turns_are_read_from_both_sides(
    server: viser.ViserServer, tilt: float
) -> None:
    words = add_words(server.scene, "/fixed", "TOM s0", "dark", (0.5, 1.0, 0.02), 0.05, tilt)
    front, back = fix(server.scene, words)
    assert not words.node.visible
    turns = [viser.transforms.SO3(node.wxyz) for node in (front, back)]
    right, up, towards = ([turn.apply(np.eye(3)[axis]) for turn in turns] for axis in (0, 1, 2))
    assert towards[0] == pytest.approx(-towards[1])
    assert up[0] == pytest.approx(up[1])  # upright from both sides
    assert right[0] == pytest.approx(-right[1])  # and no letter mirrored
    assert front.position == pytest.approx(words.node.position)
    assert b'"doubleSided":true' not in front.glb_data + back.glb_data
