"""What the parts of a training cost on this machine, beside the floor of its matrix products."""
