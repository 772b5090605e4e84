"""Records a training of stable-baselines3 while it runs (docs/your-own-loop.md)."""

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter

from tom.own_loop.run import OwnRun

OURS = {"eval/mean_reward": "eval/return", "train/critic_loss": "critic/loss"}
OURS |= {"train/actor_loss": "actor/loss", "train/ent_coef": "temperature/value"}
SETTINGS = ("learning_rate", "batch_size", "gamma", "tau", "buffer_size", "learning_starts")


class RecordCallback(BaseCallback, KVWriter):
    """A callback of `learn` that records rows, logged numbers, policies and replays.

    Every `every` steps the policy is kept and plays `episodes` (0: none), and the learners `weigh`
    weigh the buffer in a process of their own (empty: none). `options` are `tom.record`'s; a model
    that has learnt before goes on with the run. `run` is what `tom.record` returned.
    """

    run: OwnRun
