"""Many trainings: running them (driver), where (engine, home, slurm), how long (projection)."""

from tom.sweep.jobs import Job, run_jobs

__all__ = ["Job", "run_jobs"]
