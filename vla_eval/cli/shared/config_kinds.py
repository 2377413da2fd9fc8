"""Which kind of configuration a file in `configs/` is: the one place that knows all of them."""

from vla_eval.config.agents import AgentTable, is_agent_table
from vla_eval.config.evaluation import EvalConfig
from vla_eval.evaluation.model_table import ModelTable, is_model_table

ConfigClass = type[EvalConfig | ModelTable | AgentTable]
CONFIG_CLASSES: tuple[ConfigClass, ...] = (EvalConfig, ModelTable, AgentTable)


def config_class(name: str) -> ConfigClass:
    """Return what a configuration is read as; errors are those of `recipe_fields`."""
    if is_model_table(name):
        return ModelTable
    return AgentTable if is_agent_table(name) else EvalConfig
