"""Demonstration datasets: record, replay, convert, describe, share, load."""
