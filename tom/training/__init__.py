"""Trainings: from a preset to a finished run folder, resumed, or many as a fleet."""
