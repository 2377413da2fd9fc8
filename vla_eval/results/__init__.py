"""Records of episodes, the run folder they live in, and what can be said from them."""
