"""Processes and their watchdog: an answer comes for every job. Knows nothing of what a job is."""
