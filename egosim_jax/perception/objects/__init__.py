"""Objects without an id: grown around a grip, and as far as a clip shows them move."""
