"""What torch says where there is not enough memory, and what it says otherwise."""

from collections.abc import Callable

import pytest
import torch

from tom.machine.memory import MEMORY_ERRORS, is_out_of_memory


def error_of(work: Callable[[], object]) -> BaseException:
    with pytest.raises(MEMORY_ERRORS) as raised:
        work()
    return raised.value


def test_a_tensor_that_no_machine_holds_is_a_lack_of_memory():
    assert is_out_of_memory(error_of(lambda: torch.empty(2**39, 13)))


@pytest.mark.parametrize(
    "work",
    [
        lambda: torch.empty(-1),
        lambda: torch.ones(2) @ torch.ones(3),
    ],
)
def test_other_errors_are_none(work: Callable[[], object]):
    assert not is_out_of_memory(error_of(work))
