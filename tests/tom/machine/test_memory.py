"""What torch says where there is not enough memory, and what it says otherwise."""

from collections.abc import Callable

import pytest
import torch

from tom.machine.memory import REFUSING, ran_out


def error_of(work: Callable[[], object]) -> BaseException:
    with pytest.raises(REFUSING) as raised:
        work()
    return raised.value


@pytest.mark.parametrize("rows", [2**39, 2**62, 2**78])
def test_a_tensor_that_no_machine_holds_is_a_lack_of_memory(rows: int):
    """Of 28 TB, of more bytes than 64 bits count, and of more rows than that."""
    assert ran_out(error_of(lambda: torch.empty(rows, 13)))


@pytest.mark.parametrize(
    "work",
    [
        lambda: torch.empty("3"),  # pyright: ignore[reportArgumentType, reportCallIssue]
        lambda: torch.empty(-1),
        lambda: torch.ones(2) @ torch.ones(3),
        lambda: int("many"),
    ],
)
def test_other_errors_are_none(work: Callable[[], object]):
    assert not ran_out(error_of(work))
