"""D4RL files in their true layout, made here, read as transitions."""

from contextlib import contextmanager

import h5py
import numpy as np
import pytest

from tom.data.d4rl import read_d4rl
from tom.data.datasets import initial_obs, read_dataset
from tom.errors import UserError

# Three episodes of 4, 3 and 3 rows: a terminal state, a timeout, a recording that just stops.
LENGTHS, N = (4, 3, 3), 10
TERMINALS = np.array([0, 0, 0, 1, 0, 0, 0, 0, 0, 0], bool)
TIMEOUTS = np.array([0, 0, 0, 0, 0, 0, 1, 0, 0, 0], bool)
STARTS = [0, 4, 7]


def chains() -> tuple[np.ndarray, np.ndarray]:
    """obs and next_obs: row t of episode e is (100 e + t, -t); one state more than rows each."""
    states = [np.array([[100.0 * e + t, -t] for t in range(n + 1)]) for e, n in enumerate(LENGTHS)]
    obs, next_obs = (np.concatenate([s[part] for s in states]) for part in (np.s_[:-1], np.s_[1:]))
    return obs.astype(np.float32), next_obs.astype(np.float32)


@pytest.fixture
def arrays() -> dict[str, np.ndarray]:
    obs, next_obs = chains()
    return {
        "observations": obs,
        "actions": np.arange(3.0 * N, dtype=np.float32).reshape(N, 3),
        "rewards": np.arange(N, dtype=np.float32) / 4,
        "next_observations": next_obs,
        "terminals": TERMINALS,
        "timeouts": TIMEOUTS,
        "infos/qpos": np.zeros((N, 4)),
        "metadata/algorithm": np.asarray(b"SAC"),
    }


def write(path, arrays):
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            compress = {"compression": "gzip"} if np.ndim(values) else {}
            file.create_dataset(name, data=values, **compress)
    return path


def test_all_rows_in_the_order_of_collection(tmp_path, arrays):
    t = read_d4rl(write(tmp_path / "hopper.hdf5", arrays))
    for field, name in {
        "obs": "observations",
        "action": "actions",
        "reward": "rewards",
        "next_obs": "next_observations",
        "terminated": "terminals",
    }.items():
        np.testing.assert_array_equal(getattr(t, field), arrays[name])
    assert np.flatnonzero(t.truncated).tolist() == [6, 9]  # the timeout and the end of the file
    np.testing.assert_array_equal(initial_obs(t), arrays["observations"][STARTS])


def test_without_next_observations_no_transition_crosses_episodes(tmp_path, arrays):
    del arrays["next_observations"]
    t = read_d4rl(write(tmp_path / "old.hdf5", arrays))
    kept = [0, 1, 2, 4, 5, 7, 8]  # the last row of each episode has no next observation
    obs, next_obs = chains()
    np.testing.assert_array_equal(t.obs, obs[kept])
    np.testing.assert_array_equal(t.action, arrays["actions"][kept])
    np.testing.assert_array_equal(t.reward, arrays["rewards"][kept])
    np.testing.assert_array_equal(t.next_obs, next_obs[kept])
    assert not np.any(t.terminated)
    assert np.asarray(t.truncated).tolist() == [False, False, True, False, True, False, True]
    np.testing.assert_array_equal(initial_obs(t), obs[STARTS])


def test_without_timeouts_breaks_in_the_chain_truncate(tmp_path, arrays):
    del arrays["timeouts"]
    t = read_d4rl(write(tmp_path / "v0.hdf5", arrays))
    assert len(t) == N
    assert np.flatnonzero(t.terminated).tolist() == [3]
    assert np.flatnonzero(t.truncated).tolist() == [6, 9]


def test_a_terminal_state_at_the_time_limit_is_terminal(tmp_path, arrays):
    arrays["timeouts"] = TIMEOUTS | TERMINALS
    t = read_d4rl(write(tmp_path / "both.hdf5", arrays))
    assert t.terminated[3]
    assert not t.truncated[3]


def test_flags_and_rewards_of_other_types_and_shapes(tmp_path, arrays):
    expected = read_d4rl(write(tmp_path / "a.hdf5", arrays))
    arrays["rewards"] = arrays["rewards"][:, None].astype(np.float64)
    arrays["terminals"] = arrays["terminals"].astype(np.float32)
    arrays["timeouts"] = arrays["timeouts"][:, None].astype(np.uint8)
    t = read_dataset(write(tmp_path / "b.hdf5", arrays))
    for name in ("obs", "action", "reward", "next_obs", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(t, name), getattr(expected, name))
    tensors = t.torch()
    assert tensors.truncated.sum() == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"next_observations": None, "timeouts": None}, "cannot be told apart"),
        ({"rewards": None}, "no array 'rewards'"),
        ({"actions": np.zeros((N - 1, 3))}, "rows: fetch"),
        ({"next_observations": np.zeros((N, 1))}, "'next_observations' has 1 dimensions"),
        ({"observations": np.zeros((N, 4, 4, 3))}, "not numbers on 2 axes"),
        ({"actions": np.array([[b"x"]] * N)}, "not numbers on 2 axes"),
    ],
)
def test_unreadable_content_is_one_line(tmp_path, arrays, change, message):
    arrays = {k: v for k, v in {**arrays, **change}.items() if v is not None}
    path = write(tmp_path / "bad.hdf5", arrays)
    with pytest.raises(UserError, match=message) as raised:
        read_d4rl(path)
    assert "\n" not in str(raised.value)


def test_absent_foreign_and_cut_files_are_one_line(tmp_path, arrays):
    (tmp_path / "text.hdf5").write_text("hello")
    whole = write(tmp_path / "whole.hdf5", arrays).read_bytes()
    (tmp_path / "cut.hdf5").write_bytes(whole[: len(whole) // 2])
    for name in ("text.hdf5", "cut.hdf5"):
        with pytest.raises(UserError, match="not a whole HDF5 file"):
            read_dataset(tmp_path / name)
    with pytest.raises(UserError, match="no data at"):
        read_dataset(tmp_path / "absent.hdf5")


@pytest.mark.parametrize("name", ["observations", "next_observations"])
@pytest.mark.parametrize("way", ["external", "virtual", "link", "soft link to a link"])
def test_only_data_within_the_file_is_read(tmp_path, arrays, name, way):
    own = arrays.pop(name)
    path, other = write(tmp_path / "a.hdf5", arrays), tmp_path / "other.bin"
    other.write_bytes(own.tobytes())
    write(tmp_path / "other.hdf5", {name: own})
    with h5py.File(path, "a") as file:
        if way == "link":
            file[name] = h5py.ExternalLink(str(tmp_path / "other.hdf5"), name)
        elif way == "soft link to a link":
            file["there"] = h5py.ExternalLink(str(tmp_path / "other.hdf5"), name)
            file[name] = h5py.SoftLink("/there")
        else:
            stored = [(str(other), 0, own.nbytes)]
            hidden = "hidden" if way == "virtual" else name
            file.create_dataset(hidden, own.shape, own.dtype, external=stored)
        if way == "virtual":
            layout = h5py.VirtualLayout(own.shape, own.dtype)
            layout[:] = h5py.VirtualSource(".", "hidden", own.shape, own.dtype)
            file.create_virtual_dataset(name, layout)
    with pytest.raises(UserError, match="only data within the file is read"):
        read_d4rl(path)


def test_a_damaged_file_is_one_line_wherever_the_damage_is(tmp_path, arrays):
    whole = write(tmp_path / "whole.hdf5", arrays).read_bytes()
    rng, refused = np.random.default_rng(0), []
    for _ in range(100):
        torn = bytearray(whole)
        for place in rng.integers(8, len(whole), 3):
            torn[place] = rng.integers(256)
        (tmp_path / "torn.hdf5").write_bytes(torn)
        with one_line(refused):
            read_d4rl(tmp_path / "torn.hdf5")
    assert len({type(error.__cause__) for error in refused}) > 2  # of what h5py raises


@contextmanager
def one_line(refused):
    """Collects an error for the user, which is of one line."""
    try:
        yield
    except UserError as error:
        refused.append(error)
    assert all("\n" not in str(error) for error in refused)


@pytest.mark.parametrize("name", ["terminals", "timeouts"])
def test_a_flag_that_is_no_number_ends_no_episode(tmp_path, arrays, name):
    arrays[name] = np.where(np.arange(N) == 2, np.nan, arrays[name])
    with pytest.raises(UserError, match=f"'{name}' is not finite in 1 rows, first in row 2"):
        read_d4rl(write(tmp_path / "data.hdf5", arrays))
