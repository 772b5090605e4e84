"""Names of files and folders in a store and in a run folder (docs/run-folder.md)."""

import re
from pathlib import Path

SCHEMA = 1

RUN_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")

CONFIG = "config.json"
REPORT = "report.json"
"""of a weighing"""
STATUS = "status.json"
METRICS = "metrics.jsonl"
METRICS_TABLE = "metrics.parquet"
PROFILES = "weights/profiles.jsonl"
NOTICES = "notices.jsonl"
PACKED = ".gz"
"""what the names of the metrics and profiles of a small copy end with in addition"""
LABELS = "labels.json"
POLICY = "policy.npz"
POLICIES = "policies"
MODEL = "model"
BUFFER = "buffer"
SCENE = "scene.npz"
DAMAGED = "damaged"
LIVE = "live"
"""live weights of the run's buffer, a run folder without rows for each learner"""
DIGESTS = "digests.json"
LINES = (METRICS, PROFILES, NOTICES)
"""the files that grow by a row at a time"""
WEIGHINGS = "weighings"
STUDIES = "studies"
TRASH = ".trash"
VIEWS = ".views"
LOGS = ".sweep"
BESIDE_RUNS = (WEIGHINGS, STUDIES, TRASH, VIEWS, LOGS)
"""folders of a store that are not runs"""
LOCK = ".writer"
FOLDERS = ("weights", POLICIES, "episodes", BUFFER, "fields")

_NUMBERED = re.compile(r"(?:(?P<name>.+)-)?(?P<number>\d{9,18})")
_RRD = re.compile(r"run(?:-(\d+))?\.rrd")


def run_name(env: str, learner: str, seed: int, end: str) -> str:
    """A run id in which `gymnasium:Swimmer-v5` becomes `gymnasium-Swimmer-v5`."""
    task = re.sub(r"[^A-Za-z0-9._-]+", "-", env).strip("-._") or "task"
    return f"{task}-{learner}-s{seed}-{end}"


def snapshot(step: int) -> str:
    return f"weights/snapshot-{step:09d}.parquet"


def policy(step: int) -> str:
    return f"{POLICIES}/{step:09d}.npz"


def episodes(step: int) -> str:
    return f"episodes/{step:09d}.npz"


def segment(first_row: int) -> str:
    return f"{BUFFER}/{first_row:09d}.npz"


def field(name: str, step: int) -> str:
    return f"fields/{name}-{step:09d}.npz"


def numbers(folder: Path, suffix: str, name: str | None = None) -> list[int]:
    """The numbers of the files `<name>-<number><suffix>` in `folder`, ascending."""
    found = _numbered(folder, suffix)
    return sorted(int(match["number"]) for match in found if match["name"] == name)


def names(folder: Path, suffix: str) -> list[str]:
    """The names of the files `<name>-<number><suffix>` in `folder`."""
    return sorted({match["name"] for match in _numbered(folder, suffix) if match["name"]})


def rrd_files(folder: Path) -> list[Path]:
    """`run.rrd`, `run-2.rrd`, ... in the order they were written."""
    matches = [match for name in _files(folder) if (match := _RRD.fullmatch(name))]
    return [folder / match[0] for match in sorted(matches, key=lambda match: int(match[1] or 1))]


def _numbered(folder: Path, suffix: str) -> list[re.Match[str]]:
    stems = (name.removesuffix(suffix) for name in _files(folder) if name.endswith(suffix))
    return [match for stem in stems if (match := _NUMBERED.fullmatch(stem))]


def _files(folder: Path) -> list[str]:
    try:
        return [path.name for path in folder.iterdir()]
    except OSError:
        return []
