"""Memory: a fit does not copy its buffer."""

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
print((peak() - before) / (N * (2 * O + A + 3) * 4))
"""


def test_a_fit_copies_no_buffer():
    done = subprocess.run([sys.executable, "-c", FIT], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    # As a share of the buffer: indices and a few columns, never the rows.
    assert float(done.stdout) < 0.5
