"""Conformance checks for environments, policies and tasks, for us and for third parties."""
