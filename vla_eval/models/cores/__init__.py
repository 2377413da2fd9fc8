"""What policies keep from step to step: networks over time, by name. Know nothing of images."""
