"""Memory for LeRobot's SmolVLA, π0 and π0.5: earlier frames as further images, and recurrent tokens."""
