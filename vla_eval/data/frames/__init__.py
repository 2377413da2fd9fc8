"""Decoded frames of a dataset: each decoded once, cached in files, with earlier frames beside them."""
