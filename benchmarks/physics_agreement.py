"""The policy of `make train` in MJX and in C MuJoCo: at least 90 % of outcomes agree (about 8 minutes).

Usage: python -m benchmarks.physics_agreement [RUN]. Evaluates what has not been evaluated yet.
"""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from dsvla_jax.evaluation.results import compare_physics, latest, read_results


def main(run: Path) -> int:
    for physics in ("mujoco", "mjx"):
        subprocess.run([sys.executable, "eval.py", str(run), "--physics", physics, "--skip-finished"], check=True)
    results = read_results(run / "eval")
    in_c = latest(results, lambda conditions: conditions == replace(conditions, physics="mujoco"))
    in_mjx = latest(results, lambda conditions: conditions == replace(conditions, physics="mjx", loop="host"))
    tasks = compare_physics(in_c, in_mjx).tasks
    for row in tasks:
        trials = row.first.trials
        print(f"{row.task:24} {trials - row.only_first - row.only_second} of {trials} agree")
    episodes = sum(row.first.trials for row in tasks)
    total = 1 - sum(row.only_first + row.only_second for row in tasks) / episodes
    print(f"agreement {total:.3f} over {episodes} episodes (at least 0.90)")
    return int(total < 0.90)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/tiny")))
