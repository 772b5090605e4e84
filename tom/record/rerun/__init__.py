"""Rerun as a view of a run: its recording, live feed and viewer. Only this package knows it."""
