"""Road-and-rocks (paper, section 5.1): the task and all that is only for it."""
