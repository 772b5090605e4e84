"""Many trainings: running them (driver), where (engine, backend, slurm), how long (projection)."""

from tom.sweep.commands import Command, run_commands

__all__ = ["Command", "run_commands"]
