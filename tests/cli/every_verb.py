"""A small command of every verb, run as users do: by a script that lies elsewhere, in any folder."""

import os
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
TASK = "RememberColor3-v0"
ENTRY_POINT = (
    "import sys\nfrom vla_eval.cli.main import main\nif __name__ == '__main__':\n    sys.exit(main())\n"
)
"""What pip writes for `[project.scripts]`; unlike `python -m`, it does not search the working directory."""
FAKE = "--workers 1 --set simulator=fake"
EVAL = f"eval --task {TASK} --policy oracle --n-action-steps 1 2 --episodes 2 {FAKE}"
TINY_ACT = (
    *("policy.chunk_size=4", "policy.n_action_steps=4", "policy.dim_model=32", "policy.n_heads=2"),
    *("policy.dim_feedforward=32", "policy.n_encoder_layers=1", "policy.n_vae_encoder_layers=1"),
    *("policy.latent_dim=8", "policy.pretrained_backbone_weights=null", "save_every_steps=1000"),
    "num_workers=1",
)
FINETUNE = (
    f"finetune --policy act --dataset {{W}}/data/{TASK} --device cpu --batch-size 2 --allow-unreplayed "
    + " ".join(f"--set {field}" for field in TINY_ACT)
)

TINY_AGENT = (
    *("n_envs=2", "steps=16", "env={}", "simulator=fake"),
    *("arguments.n_steps=8", "arguments.batch_size=8", "network.net_arch=[8]"),
)
TRAIN_AGENT = f"train-agent --algorithm ppo --task {TASK} " + " ".join(
    f"--set {field}" for field in TINY_AGENT
)

# In this order: later ones use what earlier ones leave in {W}.
COMMANDS = {
    "init": "init {W}/own.yaml",
    "record": f"record --task {TASK} RememberShape3-v0 --episodes 2 {FAKE} --out {{W}}/data",
    "replay": "replay {W}/data --workers 1",
    "eval": f"{EVAL} --out {{W}}/run",
    "eval --serve": f"{EVAL} --serve --out {{W}}/served",
    "eval --cluster": f"{EVAL} --cluster local --out {{W}}/cluster",
    "eval --shard 1": f"{EVAL} --shard 1/2 --out {{W}}/part",
    "eval --shard 2": f"{EVAL} --shard 2/2 --out {{W}}/part",
    "merge": "merge {W}/part-shard-1-of-2 {W}/part-shard-2-of-2 --out {W}/merged",
    "report": "report {W}/run --html {W}/page",
    "compare": "compare {W}/run",
    "reproduce": f"reproduce 100/100 --task {TASK} --policy oracle --loss 0.3 {FAKE} --out {{W}}/reproduced",
    "passport": "passport {W}/run GMP",
    "check": "check oracle",
    "audit": f"audit --task {TASK} --control hold --protocol paper --episodes 2 {FAKE} --out {{W}}/audit",
    "probe": f"probe --task {TASK} --policy cue_blind --episodes 2 {FAKE} --out {{W}}/probe",
    "real": "real --robot simulated_so100 --policy oracle --stage CubeVisible --episodes 1 --out {W}/real",
    "real --teleop": "real record --robot simulated_so100 --stage CubeVisible --episodes 1 --out {W}/led",
    "view": f"view {{W}}/data/{TASK} --episode 0 --web",
    "dataset convert": f"dataset convert {{W}}/data/{TASK} --to npz --out {{W}}/npz",
    "dataset mix": f"dataset mix {{W}}/data/{TASK} {{W}}/data/RememberShape3-v0 --out {{W}}/mixed",
    "dataset check": f"dataset check {{W}}/data/{TASK}",
    "dataset adopt": f"dataset adopt {{W}}/data/{TASK}",
    "dataset check-leak": f"dataset check-leak {{W}}/data/{TASK}",
    "dataset card": f"dataset card {{W}}/data/{TASK}",
    "dataset push": f"dataset push {{W}}/data/{TASK} nobody/nothing",
    "dataset pull": "dataset pull nobody/nothing {W}/pulled",
    "finetune": f"{FINETUNE} --steps 2 --out {{W}}/trained",
    "train-agent": f"{TRAIN_AGENT} --out {{W}}/agent",
    "checkpoint verify": "checkpoint verify {W}/trained",
    "checkpoint fetch": "checkpoint fetch smolvla_base --out {W}/fetched",
    "checkpoint rehearse": "checkpoint rehearse act --device cpu --out {W}/rehearsed",
    "checkpoint convert-octo": "checkpoint convert-octo {W}/trained --out {W}/octo",
    "checkpoint convert-openvla": "checkpoint convert-openvla {W}/trained --out {W}/openvla",
    "checkpoint convert-spatialvla": "checkpoint convert-spatialvla {W}/trained --out {W}/spatialvla",
    "checkpoint merge": "checkpoint merge {W}/trained --out {W}/whole",
    "serve": "serve --policy {W}/trained --port 0",
    "list": "list",
    "show": f"show {TASK}",
    "doctor": "doctor --json",
    "bench --loader": f"bench --loader {{W}}/data/{TASK} --policy diffusion_small --batches 1 --repeats 1",
    # Its own server of a policy that computes nothing imports torch and lerobot; one of them is enough.
    "bench --serve": "bench --serve random --sessions 1 --seconds 0.1",
    "completion": "completion bash",
}
ENDLESS = {"serve": "Serving", "view": "Hosting"}
"""Commands that run until they are stopped, and a word that they print when they are ready."""
REFUSED = {"dataset adopt", "dataset push", "dataset pull", "checkpoint fetch", "checkpoint merge"} | {
    name for name in COMMANDS if name.startswith("checkpoint convert")
}
"""Commands that find no network, no dataset without records, or no checkpoint of the kind that they read."""


def verb_of(name: str) -> tuple[str, ...]:
    """Return verb and action of a command's name."""
    return tuple(name.partition(" --")[0].split())


def environment_of(work: Path, **changes: str) -> dict[str, str]:
    """Return the environment of a command: a cache of its own, no network, no interpreter options."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    own = {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(work / "cache"), "HF_HUB_OFFLINE": "1"}
    return {**kept, **own, "OMP_NUM_THREADS": "1", **changes}


def command_line(command: str, work: Path) -> list[str]:
    """Return a command with its interpreter; its results go to folders in `work`."""
    script = work / "bin" / "mikasa-vla"
    script.parent.mkdir(parents=True, exist_ok=True)
    script.write_text(ENTRY_POINT)
    return [sys.executable, str(script), *command.replace("{W}", str(work)).split()]
