"""Datasets of demonstrations: record, replay, convert, share. Knows nothing of training."""
