"""Rerun as a view of a run: its recording, the live feed and hub. Only this package knows it."""
