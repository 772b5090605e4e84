"""The variants of TOM's estimator that the tabular study compares.

They differ in settings and in how E_{a'} is taken, and some do what theory forbids.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from tom.analysis.tabular import FlowName
from tom.config import TomConfig
from tom.studies.tabular_problems import Case
from tom.training.presets import PRESETS


@dataclass(frozen=True)
class Variant:
    """A variant of the estimator: a preset of TomConfig with changes, E_{a'} exact or sampled."""

    label: str
    preset: Literal["paper", "exact"] = "exact"
    changes: Mapping[str, Any] = field(default_factory=dict)
    support: bool = False  # the policy gives its probabilities, so that E_{a'} is exact

    def config(self, case: Case) -> TomConfig:
        """The settings for a case."""
        own = {"discount": case.discount, "divergence": case.divergence, "flow": case.flow}
        return TomConfig.preset(self.preset).but(**own | dict(self.changes))


EXACT = "exact, exact expectation over a'"
VARIANTS: tuple[Variant, ...] = (
    Variant(EXACT, support=True),
    Variant("exact, 10 sampled a'"),
    Variant("exact, 1 sampled a'", changes={"action_samples": 1}),
    Variant(
        "exact, a discriminator of (s, a, s')",
        changes={"discriminator_input": "transitions"},
        support=True,
    ),
    Variant("exact, semi-gradient", changes={"semi_gradient": True}, support=True),
    Variant("exact, Q >= 0", changes={"q_non_negative": True}, support=True),
    Variant("paper, exact expectation over a'", preset="paper", support=True),
    Variant("paper, 1 sampled a'", preset="paper"),
    Variant("paper, 4 sampled a'", preset="paper", changes={"action_samples": 4}),
    Variant(
        "paper, 1 sampled a', averaged parameters and quick bias",
        preset="paper",
        changes={"parameter_average": 0.99, "q_bias_step": 0.1},
    ),
)
DENSE = Variant(f"dense MDPs: {EXACT}", support=True)
ENDING: dict[FlowName, Variant] = {
    flow: Variant(f"{flow} flow: {EXACT}", support=True)
    for flow in ("stationary", "restart", "discounted")
}
MENDED = Variant("stationary flow: mended", "paper", PRESETS["mended"]["tom"])
ENDING_PAPER = Variant("discounted flow: paper", "paper")
