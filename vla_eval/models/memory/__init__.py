"""The positive control: two small policies of ours that differ in nothing but a memory."""
