#!/bin/bash
# Trains on several nodes of a Slurm cluster:
#   sbatch cluster/slurm.sh paper_7b --mesh.data -1 --mesh.fsdp 8 --run /shared/runs/paper_7b
# One task an accelerator: each finds the others by what Slurm tells it. The run folder has to be on a file system that
# all nodes see. See docs/cluster.md.
#SBATCH --job-name=dsvla
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=8
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=8
#SBATCH --time=24:00:00
#SBATCH --output=%x-%j.log
#SBATCH --requeue
#SBATCH --open-mode=append
# Two minutes before the time is over, processes save and end.
#SBATCH --signal=TERM@120

set -u
cd "${SLURM_SUBMIT_DIR:-.}"
python=${PYTHON:-$(ls -d .venv-3*/bin/python 2>/dev/null | tail -n 1)}

# A task that fails ends the others; train.py told why before that.
srun --kill-on-bad-exit=1 --label "${python:-python3}" train.py "$@"
status=$?

# 75: a process died or fell behind, 143: told to stop. The run goes on from its newest checkpoint.
if [ "$status" -eq 75 ] || [ "$status" -eq 143 ]; then
    scontrol requeue "$SLURM_JOB_ID"
fi
exit "$status"
