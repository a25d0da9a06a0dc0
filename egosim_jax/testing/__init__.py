"""Public fixtures: sample clips in the official format, made by formula."""
