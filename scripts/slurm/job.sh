#!/usr/bin/env bash
# One command of mikasa-vla as a job; safe to requeue: the command resumes where it stopped.
#
#   sbatch --gpus-per-task=1 scripts/slurm/job.sh finetune --policy pi0 --dataset data/RememberColor3-v0
#
# The arguments are what follows `mikasa-vla`. Submit it from the root of the checkout; what the #SBATCH
# lines ask for can be changed on sbatch's command line. MIKASA_VLA names another mikasa-vla.
#
#SBATCH --job-name=mikasa-vla
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=8
#SBATCH --mem=24G
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:TERM@120
set -euo pipefail

# The folder of a dataset or a checkpoint may hold modules: Python must not search where the job is submitted.
export PYTHONSAFEPATH=1

if [ "$#" -lt 1 ]; then
  echo "usage: sbatch job.sh finetune|eval|record … --out DIR" >&2
  exit 1
fi

child=
stopped=
# 120 s before the time limit, and when the job is preempted: mikasa-vla finishes what it is writing.
trap 'stopped=1; kill -TERM "$child" 2>/dev/null || true' TERM
"${MIKASA_VLA:-.venv/bin/mikasa-vla}" "$@" &
child=$!
[ -z "$stopped" ] || kill -TERM "$child" # the signal came before there was a child to send it to
code=0
wait "$child" || code=$?
while kill -0 "$child" 2>/dev/null; do # the signal has interrupted `wait`
  code=0
  wait "$child" || code=$?
done

# 143: stopped by SIGTERM. The same command resumes where it stopped.
if [ "$code" -eq 143 ] && [ -n "${SLURM_JOB_ID:-}" ]; then
  scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
