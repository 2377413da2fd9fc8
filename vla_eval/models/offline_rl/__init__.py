"""Policies that learn from rewards of recorded episodes: conservative and implicit Q-learning."""
