"""Passports of measured rows, and two passports beside each other."""
