"""Memory: a fit does not copy its buffer, and a training's does not grow."""

import subprocess
import sys

FIT = """
import resource, torch
from tom.config import ModelConfig
from tom.data.transitions import TensorTransitions
from tom.data.replay import ReplayBuffer
from tom.dynamics import make_model
torch.set_num_threads(1)
N, O, A = 200_000, 45, 17
g = torch.Generator().manual_seed(0)
buffer = ReplayBuffer(N, O, A)
for _ in range(30):
    buffer.extend(TensorTransitions.unpack(torch.randn(N // 30, 2 * O + A + 3, generator=g), O, A))
config = ModelConfig(hidden=16, layers=1, components=2, rounds=1, batches_per_round=2)
model = make_model(O, A, config, g)
small = buffer.transitions()[:1000]
model.fit(small, torch.ones(1000), None, g)
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
before = peak()
model.fit(buffer.transitions(), torch.ones(N), None, g)
print((peak() - before) / (buffer._rows.numel() * 4))
"""

RUN = """
import torch
from tom.mbpo import Mbpo
from tom.machine.memory import keep_freed_memory
from tom.training.presets import resolve
keep_freed_memory()
torch.set_num_threads(1)
config = resolve("inverted-pendulum", "tom", "smoke", {"steps": 520, "replay_capacity": 2000})
def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 1e6
for event in Mbpo(config).events():
    if event.env_step == 310:
        before = resident()
print(resident() - before)
"""


def run(script: str) -> float:
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return float(done.stdout)


def test_a_fit_copies_no_buffer():
    assert run(FIT) < 0.5  # as a share of the buffer: indices and a few columns, never the rows


def test_a_training_does_not_grow():
    assert run(RUN) < 8.0  # MB in 210 env steps with their fits
