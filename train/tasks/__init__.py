"""Training tasks: each says what is trained, on which examples and by which loss."""
