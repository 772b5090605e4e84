"""Recordings of SAC that studies take, or make where the store has none."""

from argparse import ArgumentParser, Namespace

from tom.config import SacRecordingConfig
from tom.record import RunReader, Store
from tom.studies.study import Lab, add_env, add_jobs, add_store, tasks, whole

SAC_SEEDS = {"halfcheetah": (0,), "hopper": (0, 1)}
"""the recordings of the acceptance; other tasks have one"""


def add_recordings(parser: ArgumentParser) -> None:
    """Add the options that choose recordings of SAC and the learners' seeds."""
    add_env(parser, list(SAC_SEEDS))
    parser.add_argument("--steps", type=whole(1000), default=50_000, help="steps of SAC [50000]")
    parser.add_argument("--seeds", nargs="+", type="seed", default=[0, 1, 2], help="TOM's [0 1 2]")
    add_store(parser)
    add_jobs(parser)


def recordings(args: Namespace, lab: Lab, seeds: list[int] | None = None) -> list[RunReader]:
    """The recordings of every task and of SAC's `seeds`; missing ones are made."""
    store = Store(args.store)
    configs = [
        SacRecordingConfig(env=env, seed=seed, steps=args.steps)
        for env in tasks(args.env)
        for seed in seeds or SAC_SEEDS.get(env, (0,))
    ]
    return [recorded(store, config) or lab.record(store, config) for config in configs]


def recorded(store: Store, config: SacRecordingConfig) -> RunReader | None:
    """The newest finished recording with these settings, or None.

    Of SAC's settings those count that both versions have.
    """
    ours = config.model_dump(mode="json")
    for run in store.runs():
        if run.learner == config.learner and run.status.state == "finished":
            theirs = run.config.get("config", {})
            both = ours["sac"].keys() & theirs.get("sac", {}).keys()
            plain = ("env", "seed", "steps", "exploration_steps", "updates_per_step")
            if all(theirs.get(name) == ours[name] for name in plain) and all(
                theirs["sac"][name] == ours["sac"][name] for name in both
            ):
                return run
    return None
