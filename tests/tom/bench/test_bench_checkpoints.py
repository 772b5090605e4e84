import pytest

from tom.bench.checkpoints import _cost
from tom.record import checkpoint


def test_a_checkpoint_is_measured_with_full_buffers():
    cost = _cost("hopper", train_s=10.0)
    rows = 4 * 100_000 * (2 * 11 + 3 + 3) * 4 / 1e6  # the model buffer: four fits' rollouts
    assert rows < cost.megabytes < 1.5 * rows
    assert cost.megabytes_at_most == (checkpoint.KEPT + 1) * cost.megabytes
    assert cost.ms > 0
    assert cost.share_percent == pytest.approx(100 * cost.ms / 1e3 / (10.0 * 2000 / 250))
