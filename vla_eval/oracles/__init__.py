"""Privileged experts: the controllers of each task family. State in, action out; no simulator."""
