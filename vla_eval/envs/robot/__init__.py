"""A robot arm behind LeRobot's `Robot`, as an environment: reading, commanding, watching, an operator."""
