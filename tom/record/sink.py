"""Opens the live view of a run where there is one to open."""

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tom.events import Evaluation, Field
from tom.record.writer import RunWriter


class Sink(Protocol):
    """A best-effort view of the run. No method waits for the viewer, none raises."""

    def metrics(self, env_step: int, values: Mapping[str, float]) -> None: ...

    def profile(self, env_step: int, bins: NDArray[np.float64]) -> None: ...

    def evaluation(self, evaluation: Evaluation) -> None: ...

    def field(self, field: Field) -> None: ...

    def close(self) -> str | None:
        """End the view; returns what a reader must know about what it left out."""
        ...


def open_sink(writer: RunWriter) -> Sink | None:
    """The Rerun view of the run that `writer` writes; None for now."""
    return None
