"""Videos and rerun files of episodes. The loop knows nothing of this room."""
