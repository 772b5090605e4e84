"""Minari folders in their true layouts, made here, read as transitions."""

import json

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from tom.data.datasets import initial_obs, read_dataset
from tom.data.minari import read_minari
from tom.errors import UserError

FORMATS = ("hdf5", "arrow", "parquet")
LENGTHS = (3, 1, 2, *([2] * 9))  # twelve episodes: 10 must come after 9, not after 1


def episodes() -> list[dict[str, np.ndarray]]:
    """Episode 0 terminates, the last one is cut short without a flag, the others time out."""
    made = []
    for e, n in enumerate(LENGTHS):
        flags = np.zeros((2, n), bool)
        if e < len(LENGTHS) - 1:
            flags[min(e, 1), -1] = True
        made.append(
            {
                "observations": 100.0 * e + np.arange((n + 1) * 4.0).reshape(n + 1, 4),
                "actions": (e + np.arange(n * 2.0).reshape(n, 2)).astype(np.float32),
                "rewards": e + np.arange(n) / 8,
                "terminations": flags[0],
                "truncations": flags[1],
            }
        )
    return made


def write_hdf5(folder):
    with h5py.File(folder / "main_data.hdf5", "w", track_order=True) as file:
        for e, episode in enumerate(episodes()):
            group = file.create_group(f"episode_{e}")
            group.attrs.update({"id": e, "total_steps": LENGTHS[e]})
            for name, values in episode.items():
                maxshape = (None, *values.shape[1:])
                group.create_dataset(name, data=values, chunks=True, maxshape=maxshape)
            group.create_group("infos").create_dataset("x", data=np.zeros(LENGTHS[e] + 1))


def write_arrow(folder, form):
    for e, episode in enumerate(episodes()):
        columns = {"episode_id": np.full(LENGTHS[e] + 1, e, np.int32)}
        for name, values in episode.items():
            pad = LENGTHS[e] + 1 - len(values)
            padded = np.pad(values, ((0, pad), *([(0, 0)] * (values.ndim - 1))))
            columns[name] = padded
            if values.ndim == 2:
                kind = pa.list_(pa.from_numpy_dtype(values.dtype), values.shape[1])
                columns[name] = pa.FixedSizeListArray.from_arrays(padded.reshape(-1), type=kind)
        pyarrow.dataset.write_dataset(
            pa.RecordBatch.from_pydict(columns),
            folder,
            format=form,
            partitioning=["episode_id"],
            existing_data_behavior="overwrite_or_ignore",
        )
        (folder / str(e) / "metadata.json").write_text(json.dumps({"id": e}))


@pytest.fixture
def make(tmp_path):
    def dataset(form):
        root = tmp_path / f"hopper/{form}-v0"
        (root / "data").mkdir(parents=True)
        write_hdf5(root / "data") if form == "hdf5" else write_arrow(root / "data", form)
        about = {"total_episodes": len(LENGTHS), "data_format": form, "minari_version": "0.5.4"}
        (root / "data" / "metadata.json").write_text(json.dumps(about))
        return root

    return dataset


@pytest.mark.parametrize("form", FORMATS)
def test_all_steps_in_the_order_of_collection(make, form):
    made = episodes()
    t = read_minari(make(form))
    assert len(t) == sum(LENGTHS)
    np.testing.assert_array_equal(t.obs, np.concatenate([e["observations"][:-1] for e in made]))
    np.testing.assert_array_equal(t.next_obs, np.concatenate([e["observations"][1:] for e in made]))
    np.testing.assert_array_equal(t.action, np.concatenate([e["actions"] for e in made]))
    np.testing.assert_array_equal(t.reward, np.concatenate([e["rewards"] for e in made]))
    ends = np.cumsum(LENGTHS) - 1
    assert np.flatnonzero(t.terminated).tolist() == [ends[0]]
    assert np.flatnonzero(t.truncated).tolist() == ends[1:].tolist()
    np.testing.assert_array_equal(initial_obs(t), [e["observations"][0] for e in made])
    assert {np.asarray(a).dtype for a in (t.obs, t.action, t.reward, t.next_obs)} == {
        np.dtype(np.float32)
    }


def test_the_inner_folder_and_folders_of_older_versions(make):
    root = make("hdf5")
    expected = read_dataset(root)
    np.testing.assert_array_equal(read_dataset(root / "data").obs, expected.obs)
    (root / "data" / "metadata.json").unlink()
    np.testing.assert_array_equal(read_dataset(root).obs, expected.obs)


@pytest.mark.parametrize("form", FORMATS)
def test_an_episode_cut_short_is_one_line(make, form):
    root = make(form)
    if form == "hdf5":
        with h5py.File(root / "data/main_data.hdf5", "a") as file:
            episode = file["episode_2"]
            assert isinstance(episode, h5py.Group)
            del episode["rewards"]
            episode["rewards"] = np.zeros(1)
    else:
        part = next((root / "data/2").glob(f"*.{form}"))
        part.write_bytes(part.read_bytes()[:100])
    with pytest.raises(UserError, match="2") as raised:
        read_minari(root)
    assert "\n" not in str(raised.value)


def test_foreign_damaged_and_empty_folders_are_one_line(make, tmp_path):
    with pytest.raises(UserError, match="not a Minari dataset"):
        read_dataset(tmp_path)
    root = make("hdf5")
    with h5py.File(root / "data/main_data.hdf5", "w"):
        pass
    with pytest.raises(UserError, match="no episodes"):
        read_dataset(root)
    (root / "data/metadata.json").write_text('{"data_format": "zarr"}')
    with pytest.raises(UserError, match="'zarr' is not known"):
        read_dataset(root)
    (root / "data/metadata.json").write_text("{")
    with pytest.raises(UserError, match="damaged"):
        read_dataset(root)


def test_observations_that_are_not_flat_are_refused(make):
    root = make("hdf5")
    with h5py.File(root / "data/main_data.hdf5", "a") as file:
        episode = file["episode_0"]
        assert isinstance(episode, h5py.Group)
        del episode["observations"]
        episode.create_group("observations").create_dataset("goal", data=np.zeros((4, 2)))
    with pytest.raises(UserError, match="flat observations"):
        read_minari(root)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("terminations", np.full(3, np.nan), "'terminations' is not finite in 3 rows"),
        ("observations", np.zeros((4, 7)), "differ in width"),
        (None, np.zeros(3), "episode_0 is no episode"),
        (None, h5py.SoftLink("/nowhere"), "'episode_0' in .* is a link"),
        (None, h5py.ExternalLink("other.hdf5", "/episode_0"), "'episode_0' in .* is a link"),
    ],
)
def test_hdf5_episodes_with_something_else_in_them_are_one_line(make, name, values, message):
    root = make("hdf5")
    with h5py.File(root / "data/main_data.hdf5", "r+") as file:
        where = "episode_0" if name is None else f"episode_0/{name}"
        del file[where]
        file[where] = values
    with pytest.raises(UserError, match=message):
        read_minari(root)


def test_more_than_the_memory_holds_is_one_line(make):
    root = make("hdf5")
    with h5py.File(root / "data/main_data.hdf5", "r+") as file:
        del file["episode_0/rewards"]
        file.create_dataset("episode_0/rewards", shape=(10**13,), chunks=(1000,), dtype="f4")
    with pytest.raises(UserError, match="more than the free memory"):
        read_minari(root)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("rewards", pa.array(["a", "b", "c", "d"])),
        ("terminations", pa.array([False, None, True, False])),
        (
            "observations",
            pa.array([[0.0] * 4, None, [0.0] * 4, [0.0] * 4], pa.list_(pa.float64(), 4)),
        ),
    ],
)
def test_arrow_columns_without_numbers_are_one_line(make, name, values):
    root = make("parquet")
    [path] = (root / "data/0").glob("*.parquet")
    table = pq.ParquetFile(path).read()
    table = table.set_column(table.column_names.index(name), name, values)
    pq.write_table(table, path)
    with pytest.raises(UserError, match="cannot be read"):
        read_minari(root)
