"""Privileged experts, one file per task family: the laws by which the arm moves."""
