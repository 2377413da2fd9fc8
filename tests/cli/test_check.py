"""`mikasa-vla check`: one line for each requirement that is met, exit code 1 and one message otherwise."""

import sys
import textwrap
from pathlib import Path

import pytest

from tests.mikasa_vla_client.serving import MixedSums, Sums, served
from vla_eval.cli.main import main

MIXING = """
    import numpy as np
    from vla_eval.core import ActionChunk
    from vla_eval.specs import PolicySpec

    class Mixing:
        spec = PolicySpec(name="mixing", reads="last", cameras=(), states=("qpos",), chunk_size=1)

        def reset(self, episodes):
            self.total = 0.0

        def act(self, window):
            self.total += float(window.last.state["qpos"].sum())
            return ActionChunk(actions=np.full((1, 7), self.total, dtype=np.float32))

    def make(context):
        return Mixing()
"""


@pytest.mark.parametrize("policy", ["random", "oracle"])  # one on noise, one on the fake simulator
def test_what_holds_is_printed(policy: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", policy, "--task", "ShellGameTouch-v0"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f"{policy}: {len(lines) - 1} requirements checked, all met."
    assert all(line.startswith("ok  ") for line in lines[:-1])


def test_a_policy_that_mixes_episodes_is_told_where_to_keep_its_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mixing_policy.py").write_text(textwrap.dedent(MIXING))
    (tmp_path / "mixing.yaml").write_text(
        "version: 1\ndescription: mixes\nadapter: mixing_policy:make\ndefault_n_action_steps: 1\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["check", str(tmp_path / "mixing.yaml")]) == 1
    assert "Keep your state by `window.slot`" in capsys.readouterr().err
    sys.modules.pop("mixing_policy")


def test_a_server_is_checked_over_the_wire(capsys: pytest.CaptureFixture[str]) -> None:
    with served(Sums()) as url:
        assert main(["check", url]) == 0
    assert capsys.readouterr().out.endswith("requirements checked, all met.\n")
    with served(MixedSums()) as url:
        assert main(["check", url]) == 1
    assert "Keep the policy's memory by `session_id`" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["orcle"], "Did you mean 'oracle'"),
        (["random", "--timeout-seconds", "1"], "are for the address of a server"),
        (["ws://127.0.0.1:1", "--task", "RememberColor3-v0"], "a server says itself what it reads"),
        (["ws://127.0.0.1:1", "--api-key-env", "NO_SUCH"], "the variable 'NO_SUCH' is not set"),
        (["ws://127.0.0.1:1", "--timeout-seconds", "0"], "expected a number above 0, found 0"),
        (["ws://127.0.0.1:1"], "no connection"),
        (["one_frame"], "Leave this task out"),
    ],
)
def test_a_mistake_is_one_message(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", *arguments]) == 1
    assert message in capsys.readouterr().err
