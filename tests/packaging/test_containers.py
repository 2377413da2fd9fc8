"""Container recipes and GitHub's workflow do what a person does: `make setup`, and `bash .ci/run`."""

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]


def test_the_workflow_runs_what_everybody_runs() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    (job,) = workflow["jobs"].values()
    assert [step["run"] for step in job["steps"] if "run" in step][-1] == "bash .ci/run"


def test_containers_are_made_by_make_setup_in_one_folder() -> None:
    docker, apptainer = (
        (ROOT / "containers" / name).read_text(encoding="utf-8") for name in ("Dockerfile", "apptainer.def")
    )
    assert "RUN make setup" in docker and re.search(r"^    make setup$", apptainer, re.M)
    # An environment knows its own path: it has to be made where it is used.
    folders = {path for text in (docker, apptainer) for path in re.findall(r"(/opt/[\w-]+)", text)}
    assert folders == {"/opt/mikasa-vla-eval"}
    assert {re.search(r"debian:\d+", text)[0] for text in (docker, apptainer)} == {"debian:13"}  # type: ignore[index]


def test_no_environment_or_result_is_copied_into_an_image() -> None:
    ignored = (ROOT / "containers" / "Dockerfile.dockerignore").read_text(encoding="utf-8").splitlines()
    assert {".venv", "runs", "data", "outputs"} <= set(ignored)
