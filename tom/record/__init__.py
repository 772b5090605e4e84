"""The record of a run: files that are the truth, and Rerun as a view. Never slows training."""
