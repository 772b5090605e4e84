"""`tom` in tasks of the user's own: trained, gone on with and weighed; bad input leaves nothing."""

import json
from pathlib import Path

import pytest
from commands import OWN_TASK, fails, works
from same_records import last_row

from tom.record.reader import RunReader

MODULE = f"""
{OWN_TASK}

class Falling(PendulumEnv):
    # The program ends in its fourth episode.

    episodes = 0

    def reset(self, **options):
        self.episodes += 1
        if self.episodes > 3:
            raise SystemExit
        return super().reset(**options)


gym.register("Falling-v0", Falling, max_episode_steps=20)
IMPORTED = open("imported", "a").write("x")


def numbers(obs):
    return obs[:, 0]
"""
TRAIN = "train --env own_tasks:Own-v0 --learner tom --preset smoke --no-rerun --store runs"
RULE = "--termination own_tasks:fallen"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A folder that is not the source, with a module of the user's."""
    (tmp_path / "own_tasks.py").write_text(MODULE)
    return tmp_path


def test_a_task_and_a_rule_of_ones_own(home: Path):
    works(f"{TRAIN} {RULE} --steps 400 --run-id whole", home)
    works(f"{TRAIN} {RULE} --steps 300 --run-id parts", home)
    whole, parts = (RunReader(home / "runs" / name) for name in ("whole", "parts"))
    assert whole.config["config"]["model"]["termination"] == "own_tasks:fallen"
    assert whole.config["task"]["obs_scale"] == [1, 1, 8]
    assert whole.config["task"]["action_high"] == [2]
    assert (whole.metrics()["rollout/terminated"].to_numpy() > 0).any()

    (home / "imported").unlink()
    again, known = "train --resume parts --steps 400 --store runs", "--env own_tasks:Own-v0"
    fails(again, home, f"add {known}")
    works(f"runs list {known} --store runs", home)
    works("runs show whole --store runs", home)
    fails("weigh parts --policy parts --store runs", home, known)
    assert not (home / "imported").exists()  # none of these needs it
    other = "--termination own_tasks:numbers"
    fails(f"{again} {known} {other}", home, "was made with own_tasks:fallen")
    fails(f"{again} {known}", home, f"add {RULE}")
    works(f"{again} --no-rerun {known} {RULE}", home)
    assert last_row(parts) == last_row(whole)
    quick = f"--learner mle pmac --seeds 0 --footprint 100 --json {known}"
    said = works(f"weigh whole --policy whole --store runs {quick}", home)
    assert len(json.loads(said)["results"]) == 2


@pytest.mark.parametrize(
    "env", ["own_tasks:Own-v0", pytest.param("gymnasium:Reacher-v5", marks=pytest.mark.slow)]
)
def test_a_buffer_of_another_task_is_brushed(home: Path, env: str):
    """Reacher's robot has joints that its observations do not hold: there are no ghosts."""
    small = "--learner mle --preset smoke --steps 300 --no-rerun --evaluation.every 150"
    works(f"train --env {env} {small} --run-id brushed --store runs", home)
    step = RunReader(home / "runs/brushed").snapshot_steps()[-1]
    (home / "rows.txt").write_text("1\n2\n3\n")
    words = f"brush brushed --rows rows.txt --step {step} --seeds 0 --factors 4 --store runs"
    if env.startswith("own_tasks"):
        fails(words, home, f"add --env {env}")
    works(f"{words} --env {env} --json --out brush", home)
    report = json.loads((home / "brush/report.json").read_text())
    assert {result["factor"] for result in report["results"]} == {1, 4}
    assert not (home / "brush/ghosts.npz").exists()


def test_a_task_that_fails_ends_its_training_and_is_named(home: Path):
    words = TRAIN.replace("Own-v0", "Falling-v0")
    named = "failed: the reset of the episode of seed"
    fails(f"{words} --steps 300 --run-id fails", home, named, code=1)
    status = RunReader(home / "runs/fails").status
    assert status.state == "failed"
    assert status.reason.startswith("step ")
    assert "'own_tasks:Falling-v0' fails: SystemExit" in status.reason
    assert "(own_tasks.py, line" in status.reason
