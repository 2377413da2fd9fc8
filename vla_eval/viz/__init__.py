"""Videos and rerun files of episodes. Knows nothing of policies; the loop knows nothing of this room."""
