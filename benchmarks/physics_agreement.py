"""The policy of `make train` in MJX and in C MuJoCo: at least 90 % of outcomes agree (about 8 minutes).

Usage: python -m benchmarks.physics_agreement [RUN]. Evaluates what has not been evaluated yet.
"""

import subprocess
import sys
from pathlib import Path

from dsvla_jax.evaluation.report import compare_physics, read_results


def main(run: Path) -> int:
    sets = []
    for physics in ("mujoco", "mjx"):
        subprocess.run([sys.executable, "eval.py", str(run), "--physics", physics, "--skip-finished"], check=True)
        sets.append(read_results(run / "eval" / f"{physics}.jsonl"))
    tasks = compare_physics(*sets).tasks
    for name, one, _, only_first, only_second in tasks:
        print(f"{name:24} {one.trials - only_first - only_second} of {one.trials} agree")
    episodes = sum(one.trials for _, one, *_ in tasks)
    total = 1 - sum(only_first + only_second for *_, only_first, only_second in tasks) / episodes
    print(f"agreement {total:.3f} over {episodes} episodes (at least 0.90)")
    return int(total < 0.90)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/tiny")))
