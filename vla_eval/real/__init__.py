"""Evaluations on a real arm: the plan, the session with an operator, its table. Knows no motor or camera."""
