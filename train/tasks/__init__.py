"""Training tasks: each has networks, examples and a loss (`update.Task`)."""
