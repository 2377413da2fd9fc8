"""OpenVLA and OpenVLA-OFT on transformers' own DINOv2, SigLIP and Llama; see `docs/openvla.md`."""
