"""ViZDoom-Two-Colors: the environment, its map, and the file format of Doom maps."""
