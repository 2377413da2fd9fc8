"""What a person looks at: videos and rerun recordings of episodes. The loop knows nothing of it."""
