"""The robots, a row each: joints, gripper, control modes, where they stand. Knows nothing of simulators."""
