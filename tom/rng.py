"""Random streams: each part of a run draws from its own named generator.

A stream depends only on the run's seed and the stream's name, so a new stream never changes another
one.
"""

import json
from typing import Any
from zlib import crc32

import numpy as np
import torch


class Streams:
    """The named random generators of one run (one seed)."""

    def __init__(self, seed: int, device: torch.device | str = "cpu") -> None:
        self.seed = seed
        self.device = torch.device(device)
        self._torch: dict[str, torch.Generator] = {}
        self._numpy: dict[str, np.random.Generator] = {}

    def torch(self, name: str) -> torch.Generator:
        """The torch generator called `name`, the same object at every call."""
        if name not in self._torch:
            fresh = torch.Generator(self.device)
            self._torch[name] = fresh.manual_seed(self.integer(name))
        return self._torch[name]

    def numpy(self, name: str) -> np.random.Generator:
        """The numpy generator called `name`, the same object at every call."""
        if name not in self._numpy:
            self._numpy[name] = np.random.default_rng(self.integer(name))
        return self._numpy[name]

    def state_dict(self) -> dict[str, Any]:
        """The state of every stream, as tensors and strings."""
        return {
            "torch": {name: g.get_state() for name, g in self._torch.items()},
            # As text, because the state of a numpy generator has integers of 128 bits.
            "numpy": {n: json.dumps(g.bit_generator.state) for n, g in self._numpy.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore every stream; generators that were returned before stay the same objects."""
        for name, value in state["torch"].items():
            self.torch(name).set_state(value)
        for name, text in state["numpy"].items():
            self.numpy(name).bit_generator.state = json.loads(text)

    def integer(self, name: str) -> int:
        """A 32-bit seed for a library that needs one (an environment's reset)."""
        return int(np.random.SeedSequence([self.seed, crc32(name.encode())]).generate_state(1)[0])


def fork(generator: torch.Generator) -> torch.Generator:
    """A new generator with a seed drawn from `generator`; its draws do not affect `generator`."""
    seed = torch.randint(2**62, (), generator=generator, device=generator.device)
    return torch.Generator(generator.device).manual_seed(int(seed))
