"""The origin of a report: command, commit, versions, runs and hours."""

import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import groupby

from tom.record import RunReader
from tom.record.versions import git_commit, machine, versions


def origin() -> dict[str, str]:
    """Command, time, commit, versions and machine of this process."""
    kind = machine()
    return {
        "command": shlex.join(["tom", *sys.argv[1:]]),
        "made": datetime.now(UTC).isoformat(" ", "minutes"),
        "commit of the report": git_commit() or "unknown",
        "versions": ", ".join(f"{name} {text}" for name, text in versions().items()),
        "machine": f"{kind['cpu']}, {kind['cores']} cores",
    }


def origin_of_runs(runs: Sequence[RunReader]) -> dict[str, str]:
    """The runs that were read: number, hours, commits, versions, seeds."""
    commits = sorted({str(run.config.get("git_commit"))[:19] for run in runs})
    torches = sorted({str(run.config.get("versions", {}).get("torch")) for run in runs})
    return {
        "runs": str(len(runs)),
        "hours of training": f"{sum(map(run_hours, runs)):.1f}",
        "commits of the runs": ", ".join(commits),
        "torch of the runs": ", ".join(torches),
        "seeds": seeds([run.seed for run in runs]),
    }


def run_hours(run: RunReader) -> float:
    """Wall-clock hours of a training, from its metrics."""
    table = run.metrics()
    if "time/wall_s" not in table:
        return 0.0
    seconds = table["time/wall_s"].dropna().to_numpy()
    return float(seconds.max(initial=0.0)) / 3600


def seeds(numbers: Sequence[int]) -> str:
    """Seeds as text with ranges: `0-3, 7`."""
    ranges = []
    for _, group in groupby(enumerate(sorted(set(numbers))), lambda pair: pair[1] - pair[0]):
        members = [seed for _, seed in group]
        ranges.append(f"{members[0]}-{members[-1]}" if len(members) > 1 else str(members[0]))
    return ", ".join(ranges)
