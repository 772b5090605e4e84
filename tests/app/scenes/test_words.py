"""Words in a 3D scene: in the page's colours, and where they are read from."""

from collections.abc import Iterator

import numpy as np
import pytest
import viser
import viser.transforms

from app.scenes.frame import PIXELS, add_words, extent, painted
from app.theme import BACKGROUND, TEXT, Mode, rgb
from tom.machine.address import free_port


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


@pytest.mark.parametrize("tilt", [0.0, 0.7, np.pi / 2])
def test_words_stand_on_their_foot_and_are_read_from_both_sides(
    server: viser.ViserServer, tilt: float
) -> None:
    across, high = extent("TOM s0", "dark", 0.05)
    assert across / high == pytest.approx(np.divide(*painted("TOM s0", "dark").shape[1::-1]))
    assert high > 0.05 * (painted("TOM s0", "dark").shape[0] - 20) / PIXELS
    foot = (0.5, 1.0, 0.02)
    front, back = add_words(server.scene, "/words", "TOM s0", "dark", foot, 0.05, tilt)
    turns = [viser.transforms.SO3(node.wxyz) for node in (front, back)]
    right, up, towards = ([turn.apply(np.eye(3)[axis]) for turn in turns] for axis in (0, 1, 2))
    assert towards[0] == pytest.approx([0, -np.sin(tilt), np.cos(tilt)])
    assert towards[1] == pytest.approx(-towards[0])
    assert up[0] == pytest.approx(up[1])  # upright from both sides
    assert right[0] == pytest.approx(-right[1])  # and no letter mirrored
    assert front.position - high / 2 * up[0] == pytest.approx(np.array(foot))
    assert back.position == pytest.approx(front.position)
    assert b'"doubleSided":true' not in front.glb_data + back.glb_data
