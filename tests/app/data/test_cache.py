"""Results are made once, and the ones asked for last are kept."""

from app.data.cache import VersionedCache


def test_a_result_is_made_once_and_the_oldest_is_forgotten() -> None:
    made: list[str] = []

    def make(name: str) -> str:
        made.append(name)
        return name.upper()

    cache: VersionedCache[str] = VersionedCache(2)
    for name in ("a", "b", "a", "c", "a", "b"):
        assert cache.get(name, lambda name=name: make(name)) == name.upper()
    assert made == ["a", "b", "c", "b"]


def test_of_what_changes_one_version_is_kept() -> None:
    cache: VersionedCache[list[int]] = VersionedCache(2)
    for version in range(3):
        assert cache.get("live", lambda v=version: [v], version) == [version]
    assert cache.get("still", lambda: [9]) == [9]
    assert cache.get("live", lambda: [0], 2) == [2]
    assert cache.get("live", lambda: [0], 1) == [0]
