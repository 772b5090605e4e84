"""Attention cinema: a run's story on one timeline, in a self-contained page."""
