"""The arms: which there are, how an action reaches them, their wrist cameras."""
