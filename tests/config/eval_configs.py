"""The smallest configuration of an evaluation, with fields changed."""

from typing import Any

from vla_eval.config.evaluation import EvalConfig
from vla_eval.strict.decoding import decode, load_yaml

MINIMAL = "name: x\ntasks: [RememberColor3-v0]\npolicies: [random]\n"


def config(text: str = "", **fields: Any) -> EvalConfig:
    data = load_yaml(MINIMAL + text, where="configs/x.yaml")
    return decode(EvalConfig, {**data, **fields}, where="configs/x.yaml")
