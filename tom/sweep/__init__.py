"""Many trainings at once.

`driver` runs them, `engine` starts their processes (`ray_engine` on a cluster), `backend` knows
where their runs are stored (`bucket`: in an object store), and `projection` estimates their hours
and bytes.
"""
