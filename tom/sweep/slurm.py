"""A sweep as a Slurm array: a script that the user reads and submits."""

import shlex
import sys
from collections.abc import Sequence
from math import ceil
from pathlib import Path

from tom.record import Store, layout
from tom.training.plan import Trial

DEFAULT_HOURS = 24
MARGIN = 1.5  # factor on the projected hours

SCRIPT = """\
#!/bin/bash
# {count} runs; submit with: mkdir -p {logs} && sbatch sweep.sh
# The store must lie on a file system that all nodes share.
#SBATCH --job-name=tom-sweep
#SBATCH --array=0-{last}
#SBATCH --cpus-per-task=1
#SBATCH --mem=8G
#SBATCH --time={hours}:00:00
#SBATCH --signal=B:TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output={logs}/slurm-%A_%a.log

# Before its time is up a task is sent SIGTERM: the training writes a checkpoint, and the task goes
# back into the queue, to go on from there.
again() {{
    kill -TERM "$task"
    wait "$task"
    scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_${{SLURM_ARRAY_TASK_ID}}"
    exit 0
}}
trap again TERM

cd {folder} || exit 1
{command} --jobs 1 --only "$SLURM_ARRAY_TASK_ID" &
task=$!
wait "$task"
"""


def script(
    trials: Sequence[Trial], store: Path, arguments: Sequence[str], hours: float | None
) -> str:
    """The script of an array with one task for each trial.

    `arguments` are those of the `tom sweep` to run, `hours` what its longest training will take.
    """
    return SCRIPT.format(
        count=len(trials),
        last=len(trials) - 1,
        hours=DEFAULT_HOURS if hours is None else max(ceil(hours * MARGIN), 1),
        logs=shlex.quote(str(Store(store.resolve()).beside(layout.LOGS))),
        folder=shlex.quote(str(Path.cwd())),
        command=shlex.join([sys.executable, "-m", "tom", *arguments]),
    ).rstrip()
