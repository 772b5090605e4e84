"""The cost of the parts of a training on this machine, against the floor of its matrix products."""
