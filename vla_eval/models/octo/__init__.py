"""Octo: a transformer over a window of frames with a diffusion head, as a LeRobot policy."""
