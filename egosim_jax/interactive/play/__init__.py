"""A page in the browser on which a person plays in a world: `egosim play` (extra `play`)."""
