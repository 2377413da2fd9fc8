"""Datasets of demonstrations: record, check, replay. What is on the disk: `features`, `manifest`."""
