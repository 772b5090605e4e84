"""Many trainings at once.

`driver` runs them in a folder (`bucket`: in an object store), `engine` starts their processes
(`ray_engine` on a cluster), and `projection` estimates their hours and bytes.
"""
