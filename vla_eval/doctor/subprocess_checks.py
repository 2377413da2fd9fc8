"""What `doctor` runs in another process, as the import itself may crash; `… NAME` prints JSON."""

import importlib
import json
import re
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any  # JSON, and modules without types

TASK = "RememberColor3-v0"
CAMERA = "base_camera"


def cv2_build() -> dict[str, Any]:
    """Return version and kind of user interface of the OpenCV that is imported."""
    cv2 = importlib.import_module("cv2")
    gui = re.search(r"^\s*GUI:\s*(\S+)", cv2.getBuildInformation(), re.MULTILINE)
    return {"version": cv2.__version__, "gui": gui[1] if gui else "unknown"}


def render_devices() -> dict[str, Any]:
    """Return the names of the devices that SAPIEN can render on."""
    summary = importlib.import_module("sapien.render").get_device_summary()
    devices = [
        block.splitlines()[0].strip()
        for block in summary.split("GPU:")[1:]
        if re.search(r"Supported:\s*1", block)
    ]
    return {"devices": devices}


def torch_devices() -> dict[str, Any]:
    """Return the GPUs that torch can use."""
    torch = importlib.import_module("torch")
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return {"version": torch.__version__, "cuda": torch.version.cuda, "devices": names}


def gpu_simulator() -> dict[str, Any]:
    """Return whether SAPIEN has downloaded its library for GPUs; the place is SAPIEN's choice."""
    version = importlib.import_module("sapien.physx").version()
    file = Path(".sapien", "physx", version, "libPhysXGpu_64.so")
    return {"version": version, "file": file.as_posix(), "present": (Path.home() / file).is_file()}


def episode() -> dict[str, Any]:
    """Render one image and run one episode with an arm that holds still."""
    factory = importlib.import_module("vla_eval.envs.factory")
    started = time.perf_counter()
    env = factory.make_env(factory.EnvSettings(task=TASK, cameras=(CAMERA,)))
    image = env.reset({0: 0}, render=True)[0].observation.images[CAMERA]
    if image.min() == image.max():
        raise RuntimeError("the image has one colour only: the driver does not render")
    for _ in range(env.spec.horizon_steps):
        env.step({0: env.hold_action(0)}, render=frozenset())
    env.close()
    height, width, _ = image.shape
    seconds = time.perf_counter() - started
    steps = env.spec.horizon_steps
    return {"task": TASK, "width": width, "height": height, "steps": steps, "seconds": seconds}


PROBES: Mapping[str, Callable[[], dict[str, Any]]] = {
    probe.__name__: probe for probe in (cv2_build, render_devices, torch_devices, gpu_simulator, episode)
}

if __name__ == "__main__":
    # The last line is the answer: packages may print at import.
    sys.stdout.write(f"\n{json.dumps(PROBES[sys.argv[1]]())}\n")
