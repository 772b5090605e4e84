"""Many trainings at once.

`driver` runs them, `engine` starts their processes, `backend` knows where their runs are stored,
`slurm` writes a script for a cluster, and `projection` estimates their hours and bytes.
"""

from tom.sweep.commands import train_all

__all__ = ["train_all"]
