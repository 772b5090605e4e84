import torch

from tom.rng import Streams, normal


def test_streams_depend_on_seed_and_name_alone():
    first, second = Streams(3), Streams(3)
    second.torch("another")
    assert torch.equal(
        torch.rand(4, generator=first.torch("a")), torch.rand(4, generator=second.torch("a"))
    )
    assert first.integer("a") != first.integer("b")
    assert first.integer("a") != Streams(4).integer("a")


def test_a_member_draws_the_same_in_any_company():
    def make(seed: int) -> torch.Generator:
        return torch.Generator().manual_seed(seed)

    together = normal([make(1), make(2)], (3, 2))
    assert torch.equal(together[1], normal([make(2)], (3, 2))[0])
