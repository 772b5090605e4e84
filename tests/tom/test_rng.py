import torch

from tom.rng import Streams


def test_streams_depend_on_seed_and_name_alone():
    first, second = Streams(3), Streams(3)
    second.torch("another")
    assert torch.equal(
        torch.rand(4, generator=first.torch("a")), torch.rand(4, generator=second.torch("a"))
    )
    assert first.integer("a") != first.integer("b")
    assert first.integer("a") != Streams(4).integer("a")
