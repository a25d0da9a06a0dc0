"""Few examples, the same ones in every run: a search for others is a matter of minutes, by hand."""

from hypothesis import settings

settings.register_profile("tests", max_examples=20, deadline=None, derandomize=True, database=None)
settings.load_profile("tests")
