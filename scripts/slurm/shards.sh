#!/usr/bin/env bash
# One shard of a run per task of a job array, without Ray; safe to requeue.
#
#   sbatch --array=1-8 scripts/slurm/shards.sh 8 eval demo --out runs/demo
#   .venv/bin/mikasa-vla merge runs/demo-shard-*-of-8 --out runs/demo
#
# The first argument is the number of shards, the others are what follows `mikasa-vla`. To run a part of
# the shards again, name them: --array=3,5. Submit it from the root of the checkout; what the #SBATCH
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

if [ "$#" -lt 2 ]; then
  echo "usage: sbatch --array=1-N shards.sh N eval|audit|probe|record … --out DIR" >&2
  exit 1
fi
shards="$1"
shift
number="${SLURM_ARRAY_TASK_ID:?expected a job array: sbatch --array=1-$shards shards.sh $shards …}"

# It has a signal end the command properly, and queues the job again.
exec bash scripts/slurm/job.sh "$@" --shard "$number/$shards"
