"""The GPU that a test asks for."""

from collections.abc import Iterator

import pytest
from gpus import emulated


@pytest.fixture(params=["made of the CPU", pytest.param("real", marks=pytest.mark.gpu)])
def gpu(request: pytest.FixtureRequest) -> Iterator[None]:
    """`cuda` for torch. The real one is asked for by `-m gpu`, and missed where there is none."""
    if request.param == "real":
        yield
        return
    with emulated():
        yield
