"""How fast this machine renders and loads, as ratios measured in one run. No result depends on it."""
