import torch

from tom.nn.trained import Adam


def tensors(seed: int, members: int = 1) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(members, 5, 3, generator=g), torch.randn(members, 1, 3, generator=g)]


def test_it_is_torchs_own_with_its_weight_decay():
    ours, theirs = tensors(0), tensors(0)
    adam = Adam(ours, 1e-2, [0.0, 0.3])
    groups = [{"params": [theirs[0]]}, {"params": [theirs[1]], "weight_decay": 0.3}]
    reference = torch.optim.Adam(groups, lr=1e-2, fused=True)
    for step in range(5):
        gradients = tensors(step + 1)
        gradients[0] = gradients[0].mT.contiguous().mT  # other strides than the parameter's
        for tensor, gradient in zip(theirs, gradients, strict=True):
            tensor.grad = gradient.contiguous()
        reference.step()
        adam.step(gradients)
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_its_state_is_loaded_in_place():
    first, second = Adam(tensors(0), 1e-2), Adam(tensors(0), 1e-2)
    kept = second.means
    first.step(tensors(1))
    second.load_state_dict(first.state_dict())
    second.parameters[0].copy_(first.parameters[0])
    for one in (first, second):
        one.step(tensors(2))
    assert torch.equal(first.parameters[0], second.parameters[0])
    assert all(torch.equal(a, b) for a, b in zip(kept, first.means, strict=True))
