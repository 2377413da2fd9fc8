"""Run any LeRobot policy in our loop. Knows no family."""
