"""Demonstrations that other programs made: read, checked, changed on request, written under our names."""
