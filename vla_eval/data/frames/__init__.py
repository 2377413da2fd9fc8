"""Decoded frames of a dataset: each decoded once, cached in files, and served with earlier ones."""
