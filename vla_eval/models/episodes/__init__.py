"""Policies trained on whole episodes, and their memory while they act. Knows no network."""
