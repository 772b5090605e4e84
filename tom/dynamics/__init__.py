"""Dynamics models: mixture density network, ensembles, linear least squares."""

import torch

from tom.config import ModelConfig
from tom.dynamics.base import DynamicsModel, FitReport
from tom.dynamics.linear import LinearDynamics
from tom.dynamics.networks import GaussianEnsemble, Mdn, MeanEnsemble

__all__ = ["DynamicsModel", "FitReport", "make_model"]

MODELS = {
    "mdn": Mdn,
    "ensemble": GaussianEnsemble,
    "mean-ensemble": MeanEnsemble,
    "linear": LinearDynamics,
}


def make_model(
    obs_dim: int, action_dim: int, config: ModelConfig, generator: torch.Generator
) -> DynamicsModel:
    """Make the dynamics model of kind `config.kind`."""
    return MODELS[config.kind](obs_dim, action_dim, config, generator)
