"""Serve one policy to many clients over WebSocket. Knows no simulator, no task's rules and no evaluation."""
