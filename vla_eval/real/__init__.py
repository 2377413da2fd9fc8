"""Evaluations and demonstrations on a real arm: plan, session, table. Knows no motor or camera."""
