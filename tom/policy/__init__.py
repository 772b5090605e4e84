"""The policy: SAC, its rollouts in the model, its steps and evaluation in the real task."""
