"""Trainings: from a preset to a finished run folder, or resumed."""
