"""Many trainings: what to run (plan), running it (driver), where (engine, home, slurm)."""

from tom.sweep.jobs import Job, run_jobs

__all__ = ["Job", "run_jobs"]
