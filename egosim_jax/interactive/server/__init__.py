"""Sessions of a world behind a server, which a killed server resumes, and their client."""
