"""Many trainings at once.

`driver` runs them, `engine` starts their processes (`ray_engine` on a cluster), `backend` knows
where their runs are stored, `worker` trains for a bucket, `slurm` writes a script for a cluster,
and `projection` estimates their hours and bytes.
"""
