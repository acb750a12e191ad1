"""The policy of `make train` in MJX and in C MuJoCo: at least 90 % of outcomes agree (about 25 minutes).

Usage: python -m benchmarks.physics_agreement [RUN]. Evaluates what has not been evaluated yet.
"""

import subprocess
import sys
from pathlib import Path

from dsvla_jax.report import read_results


def main(run: Path) -> int:
    outcomes = {}
    for physics in ("mujoco", "mjx"):
        subprocess.run([sys.executable, "eval.py", str(run), "--physics", physics, "--skip-finished"], check=True)
        results = read_results(run / "eval" / f"{physics}.jsonl")
        outcomes[physics] = {(result.task, result.seed): result.success for result in results}
    pairs = sorted(outcomes["mujoco"].keys() & outcomes["mjx"].keys())
    agreement = {}
    for task in sorted({task for task, _ in pairs}):
        mine = [outcomes["mujoco"][pair] == outcomes["mjx"][pair] for pair in pairs if pair[0] == task]
        agreement[task] = sum(mine) / len(mine)
        print(f"{task:24} {sum(mine)} of {len(mine)} agree")
    total = sum(outcomes["mujoco"][pair] == outcomes["mjx"][pair] for pair in pairs) / len(pairs)
    print(f"agreement {total:.3f} over {len(pairs)} episodes (at least 0.90)")
    return int(total < 0.90)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/tiny")))
