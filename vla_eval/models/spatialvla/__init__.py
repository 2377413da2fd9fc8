"""SpatialVLA on transformers' SigLIP, Gemma 2 and ZoeDepth; see docs/spatialvla.md."""
