"""`tom` in tasks of the user's own: trained, gone on with and weighed; bad input leaves nothing."""

import json
from pathlib import Path

import pytest
from commands import tom_process

from tom.record.reader import RunReader

MODULE = """
import gymnasium as gym
from gymnasium.envs.classic_control import PendulumEnv

gym.register("Own-v0", PendulumEnv, max_episode_steps=60)


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


def fallen(obs):
    return obs[:, 0] < -0.9


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


def tom(words: str, home: Path) -> tuple[int, str]:
    """The exit code and the last line that was said; a traceback is never said."""
    done = tom_process(words.split(), home)
    said = done.stderr + done.stdout
    assert "Traceback" not in said, said
    return done.returncode, (done.stderr if done.returncode else done.stdout).strip()


def metrics(home: Path, run_id: str) -> list[dict]:
    rows = (home / "runs" / run_id / "metrics.jsonl").read_text().splitlines()
    found = [json.loads(row) for row in rows]
    return [{k: v for k, v in row.items() if not k.startswith("time/")} for row in found]


def test_a_task_and_a_rule_of_ones_own(home: Path):
    assert tom(f"{TRAIN} {RULE} --steps 400 --run-id whole", home)[0] == 0
    assert tom(f"{TRAIN} {RULE} --steps 300 --run-id parts", home)[0] == 0
    config = json.loads((home / "runs/whole/config.json").read_text())
    assert config["config"]["model"]["termination"] == "own_tasks:fallen"
    assert config["task"]["obs_scale"] == [1, 1, 8]
    assert config["task"]["action_high"] == [2]
    assert max(row.get("rollout/terminated", 0) for row in metrics(home, "whole")) > 0

    (home / "imported").unlink()
    code, said = tom("train --resume parts --steps 400 --store runs", home)
    assert (code, "add --env own_tasks:Own-v0" in said) == (2, True), said
    for words in ("runs list --store runs", "runs show whole --store runs"):
        assert tom(words, home)[0] == 0
    code, said = tom("weigh parts --policy parts --store runs", home)
    assert (code, "--env own_tasks:Own-v0" in said) == (2, True), said
    assert not (home / "imported").exists()  # none of these named it
    code, said = tom(
        "train --resume parts --steps 400 --store runs --env own_tasks:Own-v0 "
        "--termination own_tasks:numbers", home,
    )  # fmt: skip
    assert (code, "was made with own_tasks:fallen" in said) == (2, True), said
    code, said = tom("train --resume parts --store runs --env own_tasks:Own-v0 --steps 400", home)
    assert (code, "add --termination own_tasks:fallen" in said) == (2, True), said
    words = (
        f"train --resume parts --steps 400 --no-rerun --store runs --env own_tasks:Own-v0 {RULE}"
    )
    assert tom(words, home)[0] == 0
    assert metrics(home, "parts")[-1] == metrics(home, "whole")[-1]
    quick = "--learner mle pmac --seeds 0 --footprint 100 --json --env own_tasks:Own-v0"
    code, said = tom(f"weigh whole --policy whole --store runs {quick}", home)
    assert code == 0, said
    assert len(json.loads(said)["results"]) == 2


@pytest.mark.parametrize(
    "env", ["own_tasks:Own-v0", pytest.param("gymnasium:Reacher-v5", marks=pytest.mark.slow)]
)
def test_a_buffer_of_another_task_is_brushed(home: Path, env: str):
    """Reacher's robot has joints that its observations do not hold: there are no ghosts."""
    small = "--learner mle --preset smoke --steps 300 --no-rerun --evaluation.every 150"
    assert tom(f"train --env {env} {small} --run-id brushed --store runs", home)[0] == 0
    step = RunReader(home / "runs/brushed").snapshot_steps()[-1]
    (home / "rows.txt").write_text("1\n2\n3\n")
    words = f"brush brushed --rows rows.txt --step {step} --seeds 0 --factors 4 --store runs"
    if env.startswith("own_tasks"):
        code, said = tom(words, home)
        assert (code, f"add --env {env}" in said) == (2, True), said
    code, said = tom(f"{words} --env {env} --json --out brush", home)
    assert code == 0, said
    report = json.loads((home / "brush/report.json").read_text())
    assert {result["factor"] for result in report["results"]} == {1, 4}
    assert not (home / "brush/ghosts.npz").exists()


def test_a_task_that_fails_ends_its_training_and_is_named(home: Path):
    words = TRAIN.replace("Own-v0", "Falling-v0")
    code, said = tom(f"{words} --steps 300 --run-id fails", home)
    assert code == 1
    line = said.splitlines()[-1]
    assert "failed: the reset of the episode of seed" in line
    assert "'own_tasks:Falling-v0' fails: SystemExit" in line
    assert "(own_tasks.py, line" in line
    status = json.loads((home / "runs/fails/status.json").read_text())
    assert status["state"] == "failed"
    assert status["reason"].startswith("step ")
    assert "own_tasks:Falling-v0" in status["reason"]
