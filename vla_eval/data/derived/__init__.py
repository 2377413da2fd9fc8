"""Datasets made from datasets: another control mode, other actions, several mixed, rebuilt."""
