"""Plain policies that remember by a layer over time alone: an image encoder, a core, a head."""
