"""One training from its preset to a finished run folder; taken up again; many as a fleet."""
