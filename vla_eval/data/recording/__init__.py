"""Record demonstrations: seeds, episodes, shards, whole datasets; resumable. Knows no training."""
