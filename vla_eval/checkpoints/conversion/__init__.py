"""Make a LeRobot checkpoint of a published one: a file per model. No code of the checkpoint is run."""
