"""What a report was made with: command, commit, versions, runs and hours."""

import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import groupby

from tom.record import RunReader
from tom.record.versions import git_commit, machine, versions


def origin() -> dict[str, str]:
    """This process: command, time, commit, versions, machine."""
    kind = machine()
    return {
        "command": shlex.join(["tom", *sys.argv[1:]]),
        "made": datetime.now(UTC).isoformat(" ", "minutes"),
        "commit of the report": git_commit() or "unknown",
        "versions": ", ".join(f"{name} {text}" for name, text in versions().items()),
        "machine": f"{kind['cpu']}, {kind['cores']} cores",
    }


def origin_of(runs: Sequence[RunReader]) -> dict[str, str]:
    """This process and the runs that it read: how many, which commits and versions, their hours."""
    commits = sorted({str(run.config.get("git_commit"))[:19] for run in runs})
    torches = sorted({str(run.config.get("versions", {}).get("torch")) for run in runs})
    made = origin()
    made["runs"] = str(len(runs))
    made["hours of training"] = f"{sum(map(run_hours, runs)):.1f}"
    made["commits of the runs"] = ", ".join(commits)
    made["torch of the runs"] = ", ".join(torches)
    return made


def run_hours(run: RunReader) -> float:
    """Wall-clock hours of a training, as its metrics tell."""
    table = run.metrics()
    if "time/wall_s" not in table:
        return 0.0
    seconds = table["time/wall_s"].dropna().to_numpy()
    return float(seconds.max(initial=0.0)) / 3600


def seeds(numbers: Sequence[int]) -> str:
    """Seeds as text, runs of them in short: `0-3, 7`."""
    found = []
    for _, group in groupby(enumerate(sorted(set(numbers))), lambda pair: pair[1] - pair[0]):
        members = [seed for _, seed in group]
        found.append(f"{members[0]}-{members[-1]}" if len(members) > 1 else str(members[0]))
    return ", ".join(found)
