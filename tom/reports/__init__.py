"""Figures for paper and docs: pure functions from data to a Matplotlib figure."""
