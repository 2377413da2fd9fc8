"""Policies: the chunk executor, scripted controls, and one adapter per model family."""
