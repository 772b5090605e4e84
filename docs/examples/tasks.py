"""A task under a name of its own, with what its observations are called, and a rule for its ends.

    tom train --env swimmer --learner tom --plugin docs/examples/tasks.py
    tom train --env gymnasium:MountainCarContinuous-v0 --learner tom --termination at-the-goal \
        --plugin docs/examples/tasks.py
"""

NAMES = (
    *("body angle", "joint 1 angle", "joint 2 angle"),
    *("x velocity", "y velocity", "body angular velocity"),
    *("joint 1 angular velocity", "joint 2 angular velocity"),
)


def never(next_obs):
    """A swimmer never falls: next observations (B, O) -> a bool tensor (B,)."""
    return next_obs.new_zeros(len(next_obs)).bool()


def at_the_goal(next_obs):
    """The mountain car's position, in its own units."""
    return next_obs[:, 0] >= 0.45


def register(registry):
    registry.task(
        "swimmer", "Swimmer-v5", never, obs_names=NAMES, settings={"sac": {"discount": 0.995}}
    )
    registry.termination("at-the-goal", at_the_goal)
