"""The servers of `docs/released_policies.md`, word for word but for port and device, with stand-ins.

A stand-in takes and returns what the authors' code does, and remembers as it does; there are no weights here.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from tests.peers.programs import PLUGIN, example, free_port, running, with_path
from vla_eval.cli.main import main
from vla_eval.data.foreign.import_writer import eef_of_proprio
from vla_eval.testing.check_remote import check_remote

PAGE = "released_policies.md"
GMP = """
import torch
class Policy:
    def __init__(self):
        self.history = {}
    def predict_action(self, batch):
        assert batch["third_person_camera"].shape == (1, 1, 3, 256, 256)
        frames = self.history.setdefault(int(batch["episode_idx"]), [])
        frames.append(batch["third_person_camera"].mean())
        mean = torch.stack(frames).mean()
        return {"action0_8d": mean + torch.randn(1, 2, 8)}
class Normalizer:
    def normalize(self, batch):
        return batch
    unnormalize = normalize
def load_policy(path, device):
    return Policy(), Normalizer(), 2
def obs_to_policy_input(obs, num_envs, device, no_proprio):
    assert obs["rgb"].shape == (1, 128, 128, 6) and obs["joints"].shape == (1, 25) and no_proprio
    image = obs["rgb"].float().permute(0, 3, 1, 2)[:, None] / 255
    zoom = torch.nn.functional.interpolate(image[0], (256, 256))[None]
    return {"third_person_camera": zoom[:, :, :3], "episode_idx": torch.arange(num_envs)}
"""
SIMPLEMEMVLA = """
import numpy as np
def predict(frames, wrist, state, instruction):
    assert 1 <= len(frames) <= 60 and frames.shape[1:] == wrist.shape == (128, 128, 3)
    assert state.shape == (25,)
    return np.full((16, 8), frames.mean() / 255 + len(instruction) / 1000, dtype=np.float32)
"""
MUVLA = """
import numpy as np
class Tokens(np.ndarray):
    def to(self, device, dtype):
        return self
class Memory:
    def get_initial_state(self, batch_size):
        return np.zeros((batch_size, 64, 4)).view(Tokens)
class Model:
    device, dtype = "cpu", float
class GenerateConfig:
    attention_mask_mode = "custom"
    def __init__(self, pretrained_checkpoint):
        self.pretrained_checkpoint = pretrained_checkpoint
def validate_config(config):
    pass
def initialize_model(config):
    return Model(), None, None, None, Memory()
"""
MUVLA_ACTION = """
import numpy as np
def get_action(config, model, obs, instruction, *, memory_state, **others):
    assert obs["state"].shape == (7,) and memory_state.shape == (1, 64, 4)
    memory = 0.5 * memory_state + obs["full_image"].mean() / 255
    return [np.full(7, float(memory.mean()) - 0.5) for _ in range(8)], memory
"""
STAND_INS = {
    "gmp_server.py": {"policy.py": GMP},
    "simplememvla_server.py": {"my_simplememvla.py": SIMPLEMEMVLA},
    "muvla_server.py": {
        "experiments/robot/mikasa_robo/run_mikasa_robo_eval.py": MUVLA,
        "experiments/robot/robot_utils.py": MUVLA_ACTION,
    },
}


def write_server(name: str, folder: Path, port: int) -> None:
    for path, text in STAND_INS[name].items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    text = example(PAGE, name).replace("8000", str(port)).replace('"cuda"', '"cpu"')
    (folder / name).write_text(text)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", list(STAND_INS))
def test_a_server_keeps_the_protocol_and_its_sessions_apart(name: str, tmp_path: Path) -> None:
    port = free_port()
    write_server(name, tmp_path, port)
    with running([sys.executable, name], port, cwd=tmp_path, env=with_path(PLUGIN, tmp_path)):
        assert "GET /healthz answers 200." in check_remote(f"ws://127.0.0.1:{port}")


def test_a_policy_for_another_control_mode_is_refused_and_not_misread(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = free_port()
    write_server("simplememvla_server.py", tmp_path, port)
    words = ("--task", "RememberColor3-v0", "--episodes", "1", "--workers", "1", "--set", "simulator=fake")
    server = [sys.executable, "simplememvla_server.py"]
    with running(server, port, cwd=tmp_path, env=with_path(PLUGIN, tmp_path)):
        url, out = f"ws://127.0.0.1:{port}", str(tmp_path / "run")
        assert main(["eval", *words, "--policy", url, "--out", out]) == 1
    assert "pd_joint_pos" in capsys.readouterr().err


def test_the_angles_of_muvla_are_those_of_the_authors_wrapper() -> None:
    source = example(PAGE, "muvla_server.py")
    function = source[source.index("def xyz_rpy_width") : source.index("class MemoryTokens")]
    names: dict[str, object] = {"np": np}
    exec(function, names)
    theirs = np.array([0.1, -0.2, 0.3, 3.0, -0.4, 1.2, 0.08], dtype=np.float32)
    ours = names["xyz_rpy_width"](eef_of_proprio(theirs))  # type: ignore[operator]
    assert ours == pytest.approx(theirs, abs=1e-5)
