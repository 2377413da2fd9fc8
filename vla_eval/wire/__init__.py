"""Bytes and messages of a policy behind a socket. Knows no policy, no simulator and no evaluation."""
