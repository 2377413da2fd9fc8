#!/usr/bin/env bash
# One command on all nodes of one allocation, by a Ray cluster that is started and ended with it.
#
#   sbatch --nodes=4 scripts/slurm/ray.sh eval demo --out runs/demo
#
# The arguments are what follows `mikasa-vla`; --cluster auto is added. Submit it from the root of the
# checkout, which all nodes must see under the same path. At the end `ray symmetric-run` stops every Ray
# process of yours on the nodes, so they are asked for exclusively. Not verified on a Slurm cluster.
#
#SBATCH --job-name=mikasa-vla-ray
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --exclusive
#SBATCH --cpus-per-task=16
#SBATCH --mem=64G
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
set -euo pipefail

bin="$(cd "${MIKASA_VLA_BIN:-.venv/bin}" && pwd)"
export PATH="$bin:$PATH" # `ray symmetric-run` calls `ray`
nodes="${SLURM_JOB_NUM_NODES:?expected an allocation: sbatch --nodes=2 ray.sh …}"
head="$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)"
address="$(srun --nodes=1 --ntasks=1 --nodelist="$head" hostname --ip-address | cut -d' ' -f1)"

# Anyone who reaches Ray's ports can run code: only processes of this job know the token.
RAY_AUTH_TOKEN="$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')"
export RAY_AUTH_TOKEN RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0

# Ray's own helpers are started by `python -c` and `-m`: they must not search the working directory for modules.
export PYTHONSAFEPATH=1

# Starts Ray on each node, runs the command on the first one, and stops Ray everywhere.
exec srun --nodes="$nodes" --ntasks="$nodes" --ntasks-per-node=1 \
  "$bin/ray" symmetric-run --address "$address:6379" --min-nodes "$nodes" \
  --num-cpus "${SLURM_CPUS_PER_TASK:-1}" --include-dashboard=false \
  -- "$bin/mikasa-vla" "$@" --cluster auto
