"""Any Gymnasium task: its units, its episodes played again, its geometry; what cannot be used."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from common import one_line, present
from gymnasium.envs.mujoco.swimmer_v5 import SwimmerEnv

from tom.envs import ENVS, scene, task
from tom.envs.environment import capture, restore
from tom.envs.gymnasium_task import GymnasiumTask, describe
from tom.envs.termination import NEVER, RULES, rule
from tom.errors import OwnCodeError, StartAgainError, UserError

MUJOCO = ("Swimmer-v5", "Reacher-v5", "Pusher-v5")
OTHERS = ("Pendulum-v1", "MountainCarContinuous-v0")
each = pytest.mark.parametrize("gym_id", MUJOCO + OTHERS)


BOX = gym.spaces.Box(-1, 1, (2,))
NAMED: dict[str, gym.Space] = {"speed": gym.spaces.Box(-np.inf, np.inf, ()), "to_target": BOX}


class Arm(gym.Env):
    """Observes as DeepMind Control's tasks do."""

    observation_space = gym.spaces.Dict(NAMED)
    action_space = BOX

    def reset(self, *, seed=None, options=None):
        return {"speed": np.array(3.0), "to_target": np.array([0.25, -0.5])}, {}

    def step(self, action):
        return self.reset()[0], 0.0, False, False, {}


class Flat(gym.Env):
    """What `reset` and `step` return is asked of the class."""

    observation_space = action_space = BOX
    first: object = np.zeros(2)
    second: tuple = (np.zeros(2), 0.0, False, False, {})

    def reset(self, *, seed=None, options=None):
        return self.first, {}

    def step(self, action):
        return self.second


class Late(Flat):
    """Its third reward is no number."""

    steps = 0

    def step(self, action):
        self.steps += 1
        return np.zeros(2), np.nan if self.steps == 3 else 0.0, False, False, {}


class Strict(Flat):
    """Takes nothing beyond its bounds, which single precision cannot hold."""

    action_space = gym.spaces.Box(-0.1, 0.1, (2,), np.float64)

    def step(self, action):
        assert self.action_space.contains(action)
        return self.second


class Forgetful(Flat):
    """Its start does not follow the seed."""

    starts = iter(range(10_000))

    def reset(self, *, seed=None, options=None):
        return np.full(2, next(self.starts) / 10_000), {}


class Swimming(SwimmerEnv):
    """A robot that returns an array that it goes on changing."""

    def step(self, action):
        obs, reward, *_ = super().step(action)
        self.own = getattr(self, "own", obs)
        self.own[:] = obs
        return self.own, reward, False, False, {}


MADE: dict[str, tuple[type[gym.Env], dict]] = {
    "dm_control/arm-reach-v0": (Arm, {}),
    "Forgetful-v0": (Forgetful, {}),
    "Late-v0": (Late, {}),
    "Strict-v0": (Strict, {}),
    "Pictures-v0": (Flat, {"observation_space": gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)}),
    "Still-v0": (Flat, {"action_space": gym.spaces.Box(np.zeros(2), np.arange(2.0))}),
    "Wide-v0": (Flat, {"first": np.zeros(3)}),
    "Swim-v0": (Swimming, {}),
}
for name, (kind, parts) in MADE.items():
    gym.register(name, type("Made", (kind,), parts))  # pyright: ignore[reportArgumentType]


def named(gym_id: str) -> GymnasiumTask:
    found = task(f"gymnasium:{gym_id}")
    assert isinstance(found, GymnasiumTask)
    return found


@each
def test_units_are_the_tasks_own_bounds(gym_id: str):
    known, raw = named(gym_id), gym.make(gym_id)
    assert raw.spec is not None
    assert isinstance(raw.action_space, gym.spaces.Box)
    assert isinstance(raw.observation_space, gym.spaces.Box)
    env = known.make()
    obs, first = env.reset(seed=3)[0], raw.reset(seed=3)[0]
    assert known.max_episode_steps == raw.spec.max_episode_steps
    for action in np.random.default_rng(0).uniform(-1, 1, (30, known.action_dim)):
        assert known.own_obs(obs) == pytest.approx(first, rel=1e-5, abs=1e-5)
        assert known.unit_obs(first) == pytest.approx(obs, rel=1e-5, abs=1e-5)
        own = raw.action_space.low + (action + 1) / 2 * np.ptp(
            [raw.action_space.low, raw.action_space.high], axis=0
        )
        obs, reward, *_ = env.step(action)
        first, other, *_ = raw.step(own.astype(np.float32))
        assert reward == pytest.approx(float(other), rel=1e-4, abs=1e-5)
    bounded = np.isfinite(raw.observation_space.low)
    assert (np.abs(obs)[bounded] <= 1 + 1e-6).all()


@each
def test_an_episode_is_put_back_to_the_bit(gym_id: str):
    known, actions = named(gym_id), np.random.default_rng(1).uniform(-1, 1, (90, 7))
    env, other = known.make(), known.make(seed=9)

    def play(env: gym.Env, rows: np.ndarray) -> list[np.ndarray]:
        seen = []
        for row in rows:
            obs, _, terminated, truncated, _ = env.step(row[: known.action_dim])
            seen.append(env.reset()[0] if terminated or truncated else obs)
        return seen

    env.reset(seed=5)
    play(env, actions[:57])
    restore(other, capture(env))
    assert np.array_equal(play(env, actions[57:]), play(other, actions[57:]))


def test_a_task_that_does_not_repeat_itself_cannot_go_on():
    known = named("Forgetful-v0")
    assert known.max_episode_steps == 1000  # its specification sets no limit
    env = known.make()
    env.reset(seed=0)
    with pytest.raises(StartAgainError):
        restore(known.make(), capture(env))


def test_named_arrays_of_deepmind_control_lie_side_by_side():
    known = named("dm_control/arm-reach-v0")
    assert known.obs_names == ("speed", "to target 1", "to target 2")
    env = known.make()
    obs, _ = env.reset(seed=0)
    assert obs.tolist() == [3.0, 0.25, -0.5]
    assert env.step(np.zeros(2))[0].shape == (3,)


@pytest.mark.parametrize("gym_id", ["Swimmer-v5", "Pusher-v5", "Humanoid-v5"])
def test_a_robot_is_drawn_from_what_its_run_keeps(gym_id: str):
    model = present(scene.build_model(named(gym_id)))
    again = scene.of_arrays(scene.arrays(model))
    spread = np.random.default_rng(0).normal(size=(5, model.mj.nq))
    qpos = model.mj.qpos0 + 0.3 * spread
    own, kept = (scene.geometry(one.mj, qpos) for one in (model, again))
    for a, b in zip(own.shapes, kept.shapes, strict=True):
        for part in ("size", "color", "center", "axis"):
            assert getattr(a, part) == pytest.approx(getattr(b, part), abs=1e-5)
    assert own.root == pytest.approx(kept.root, abs=1e-5)
    assert (own.floor, model.dt) == (kept.floor, again.dt)
    assert sum(len(shape.size) for shape in own.shapes) >= 3


def test_joints_are_found_in_observations_where_they_are():
    found = {gym_id: named(gym_id).root_dims for gym_id in (*MUJOCO, "HalfCheetah-v5", "Ant-v5")}
    assert found == {
        "Swimmer-v5": 2,
        "Reacher-v5": None,
        "Pusher-v5": None,
        "HalfCheetah-v5": 1,
        "Ant-v5": None,
    }
    # also in an array that the task goes on changing
    assert named("Swim-v0").root_dims == named("Swimmer-v5").root_dims


def test_rescaled_joints_are_no_joint_positions():
    """Robots are drawn from the simulator's states then, and not from numbers of another unit."""

    class Bounded(gym.ObservationWrapper):
        def __init__(self, **given) -> None:
            super().__init__(gym.make("InvertedPendulum-v5", **given))
            self.observation_space = gym.spaces.Box(-20.0, 20.0, (4,), np.float64)

        def observation(self, observation):
            return observation

    gym.register("Bounded-v0", Bounded)  # pyright: ignore[reportArgumentType]
    known = named("Bounded-v0")
    assert known.obs_scale == (20.0,) * 4
    assert known.root_dims is None
    assert known.keeps_states
    assert known.obs_names == named("InvertedPendulum-v5").obs_names


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("gymnasium:CartPole-v1", "Discrete"),
        ("gymnasium:dm_control/arm-reech-v0", "arm-reach"),
        ("gymnasium:Pictures-v0", r"Box\(8, 8, 3\)"),
        ("gymnasium:Still-v0", "dimension 0 are 0 and 0"),
        ("gymnasium:Wide-v0", r"\(3,\), not \(2,\)"),
        ("gymnasium:Swimer-v5", "Swimmer"),
        ("gymnasium:OfAScript-v0", "module:Id"),
    ],
)
def test_what_cannot_be_used_is_one_line(name: str, words: str):
    with one_line(words):
        describe(name)


def test_a_task_that_goes_wrong_later_is_one_line_that_names_the_step():
    env = named("Late-v0").make(seed=4)
    env.reset(seed=4)
    env.step(np.zeros(2))
    env.step(np.zeros(2))
    with one_line("reward of nan at step 3 of the episode of seed 4", OwnCodeError):
        env.step(np.zeros(2))


def test_a_step_lasts_as_long_as_the_task_says_in_a_number():
    for number, dt in enumerate((None, lambda self: 0.5, np.float32(0.5))):
        kind = type("Timed", (Flat,), {"dt": dt, "metadata": {"render_fps": 10}})
        gym.register(f"Timed-v{number}", kind)  # pyright: ignore[reportArgumentType]
        assert describe(f"gymnasium:Timed-v{number}").dt == (0.1 if number < 2 else 0.5)


def test_the_bounds_of_actions_are_taken_in_double_precision():
    env = named("Strict-v0").make(seed=0)
    for bound in (-1, 1):
        env.step(np.full(2, bound))


def test_a_rule_is_asked_in_the_tasks_units_and_tried_first():
    known = named("MountainCarContinuous-v0")
    RULES["test at the goal"] = lambda obs: obs[:, 0] >= 0.45
    ends = rule(known, "test at the goal")
    own = np.array([[0.5, 0.0], [0.4, 0.0]])
    assert ends(torch.from_numpy(known.unit_obs(own))).tolist() == [True, False]
    assert rule(known, None)(torch.zeros(2, 2)).tolist() == [False, False]
    assert rule(ENVS["hopper"], NEVER)(torch.zeros(1, 11)).tolist() == [False]
    RULES["test of numbers"] = lambda obs: obs[:, 0]
    with pytest.raises(UserError, match="bool"):
        rule(known, "test of numbers")
