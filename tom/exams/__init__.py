"""Measures of a fit: the shape of its weights, its model's errors, and its exam."""
