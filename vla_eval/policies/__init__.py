"""Policies: scripted controls, and one adapter per model family. Knows nothing of simulators and runs."""
