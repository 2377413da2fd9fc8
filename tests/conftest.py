"""For all tests: nothing is looked for on the Hugging Face Hub. Read when huggingface_hub is imported."""

import os

os.environ.setdefault("HF_HUB_OFFLINE", "1")
