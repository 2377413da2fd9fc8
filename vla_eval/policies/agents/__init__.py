"""Agents trained by rewards, as policies: what they are given, and their networks. Does not train."""
