"""What a terminal shows while a command runs: progress, bars, screens, streams. Knows no verb."""
