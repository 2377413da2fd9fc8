"""The part of a configuration that results depend on, and its digest."""

from typing import Any

from vla_eval.config.appearance import AS_DESIGNED
from vla_eval.config.evaluation import OPTION_FIELDS, EvalConfig
from vla_eval.config.files import content_of, digest_of
from vla_eval.evaluation.inference_choice import INFERENCE_FIELDS, inference_fields
from vla_eval.policies.recipe import bare_policy


def results_config(config: EvalConfig) -> dict[str, Any]:  # Any: plain data
    """Return the part of a configuration that results depend on; compared when a run is resumed."""
    data = content_of(config, options=OPTION_FIELDS)
    # So that runs of versions without these fields can be resumed.
    if config.slots_per_worker == 1:
        del data["slots_per_worker"]
    data = {name: value for name, value in data.items() if name not in INFERENCE_FIELDS}
    data |= inference_fields(config)
    data["policies"] = [bare_policy(name) for name in data["policies"]]
    if config.reset_policy_at_step is None:
        del data["reset_policy_at_step"]
    if config.chunking.first_inference_step == 0:
        del data["chunking"]["first_inference_step"]
    if config.cue_view == "as_shown":
        del data["cue_view"]
    if config.appearance == AS_DESIGNED:
        del data["appearance"]
    return data


def fingerprint(config: EvalConfig) -> str:
    """Return the sha256 of the part of a configuration that results depend on."""
    return digest_of(results_config(config))
