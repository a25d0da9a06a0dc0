"""The closed loop over a state, and its inputs: episodes and actions."""
