"""Processes and their watchdog: every job gets an answer. Knows nothing of what a job is."""
