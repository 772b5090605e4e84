"""The policy: SAC, rollouts in the model, steps and evaluation in the real task."""
