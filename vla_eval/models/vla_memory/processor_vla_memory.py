"""lerobot's processors of SmolVLA, π0 and π0.5, under the names by which lerobot looks for ours."""

from lerobot.policies.pi0.processor_pi0 import make_pi0_pre_post_processors
from lerobot.policies.pi05.processor_pi05 import make_pi05_pre_post_processors
from lerobot.policies.smolvla.processor_smolvla import make_smolvla_pre_post_processors

make_mikasa_smolvla_pre_post_processors = make_smolvla_pre_post_processors
make_mikasa_pi0_pre_post_processors = make_pi0_pre_post_processors
make_mikasa_pi05_pre_post_processors = make_pi05_pre_post_processors
