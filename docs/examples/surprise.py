"""A learner with settings and a network, its metric with a chart, and a page that draws both.

tom train --env hopper --learner surprise --surprise.steps 50 --plugin docs/examples/surprise.py
tom studio --plugin docs/examples/surprise.py
"""

from typing import Any

import torch
from torch import Tensor

from tom.config import Config, Count, Positive
from tom.data.sampling import normalise, uniform_indices
from tom.learners.base import FitContext, Weighting
from tom.nn.mlp import StackedMLP
from tom.nn.trained import Trained


class SurpriseConfig(Config):
    """A learner that counts a transition by the error of its reward."""

    hidden: Count = 64
    """units of the network's hidden layer"""
    steps: Count = 200
    """gradient steps at each fit"""
    batch_size: Count = 256
    lr: Positive = 1e-3


class SurpriseLearner:
    """Weights in proportion to a network's squared error of the reward."""

    def __init__(
        self, config: SurpriseConfig, obs_dim: int, action_dim: int, generator: torch.Generator
    ) -> None:
        net = StackedMLP(1, [obs_dim + action_dim, config.hidden, 1], torch.tanh, generator)
        self.config = config
        self.network = Trained(net, config.lr)

    def weigh(self, context: FitContext) -> Weighting:
        inputs = torch.cat((context.replay.obs, context.replay.action), 1)
        for _ in range(self.config.steps):
            rows = uniform_indices(len(inputs), self.config.batch_size, context.generator)
            loss = self._error(inputs[rows], context.replay.reward[rows]).mean()
            self.network.optimiser.step(torch.autograd.grad(loss, self.network.net.tensors()))
        with torch.no_grad():
            error = self._error(inputs, context.replay.reward)
        weights, _ = normalise(error)
        return Weighting(weights, metrics={"surprise/error": float(error.mean())})

    def _error(self, inputs: Tensor, reward: Tensor) -> Tensor:
        """Squared error (N,) of the reward."""
        return (self.network.net(inputs[None])[0, :, 0] - reward).square()

    def state_dict(self) -> dict[str, Any]:
        return self.network.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.network.load_state_dict(state)


def chart(curves, height):
    """A line a run, in its learner's colour."""
    import plotly.graph_objects as go  # here: a training draws nothing

    from app.figures.base import styled
    from app.theme import learner_colour

    lines = [
        go.Scatter(
            x=one.step, y=one.value, name=one.run_id, line={"color": learner_colour(one.learner)}
        )
        for one in curves
    ]
    return styled(go.Figure(lines), "env steps", height, keep="surprise")


def page():
    """How many env steps each run makes in a second, and the error of the reward."""
    import streamlit as st

    from app import session
    from app.data import readers
    from app.parts import widgets
    from app.parts.plot import chart as draw

    runs = readers.listing(session.links().store).runs
    rows = [
        {"run": run.run_id, "env steps/s": run.status.env_steps_per_s}
        for run in sorted(runs, key=lambda run: -(run.status.env_steps_per_s or 0.0))
    ]
    st.dataframe(rows, hide_index=True)
    curves = [widgets.curve(run, "surprise/error") for run in runs]
    if drawn := [curve for curve in curves if len(curve.step)]:
        draw(chart(drawn, 300), "surprise", "error of the reward against env steps")


def register(registry):
    registry.learner(
        "surprise",
        "Surprise",
        lambda c, o, a, g: SurpriseLearner(c.surprise, o, a, g),
        colour="#5f8a1f",
        settings=SurpriseConfig,
    )
    registry.metric(
        "surprise/error", "mean squared error of the reward that the network predicts", chart
    )
    registry.page("Pace", "pace", page, icon=":material/speed:")
