"""Analyses of finished runs and recorded data: weights, models, statistics."""
