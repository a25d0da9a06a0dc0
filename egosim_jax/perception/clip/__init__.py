"""A clip in a known state: it judges the predicted motion, and shows new surfaces."""
