"""Many trainings: what to run (plan), and running it here (local) or on a cluster (slurm)."""

from tom.sweep.jobs import Job, run_jobs

__all__ = ["Job", "run_jobs"]
