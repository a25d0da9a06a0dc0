"""One name table per network, as data: foreign name, our path, transform."""
