"""Road-and-rocks (paper, section 5.1): the task and all code that is specific to it."""
