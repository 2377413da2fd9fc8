"""What scripts and notebooks call, offered as `vla_eval.NAME`: each function is the code path of a verb."""
