from vla_eval.api.checking import check_policy as check_policy
from vla_eval.api.evaluating import evaluate as evaluate
from vla_eval.api.finetuning import finetune as finetune
from vla_eval.api.listing import list_policies as list_policies
from vla_eval.api.listing import list_tasks as list_tasks
from vla_eval.api.probing import run_probe as run_probe
from vla_eval.api.recording import load_dataset as load_dataset
from vla_eval.api.recording import record as record
from vla_eval.api.run import Run as Run
from vla_eval.api.run import load_run as load_run
from vla_eval.envs.gymnasium_env import make_env as make_env

__version__: str
