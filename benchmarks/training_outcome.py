"""Success rates of `make train`: mean at least 0.80, no task below 0.60, 25 unseen episodes each (seconds, after it).

Usage: python -m benchmarks.training_outcome [RUN]
"""

import sys
from pathlib import Path

from dsvla_jax.report import print_table, read_results


def main(run: Path) -> int:
    results = read_results(run / "eval" / "mujoco.jsonl")
    print_table(results)
    tasks = sorted({result.task for result in results})
    rates, short = {}, False
    for task in tasks:
        outcomes = [result.success for result in results if result.task == task]
        rates[task] = sum(outcomes) / len(outcomes)
        short |= len(outcomes) < 25
    mean, lowest = sum(rates.values()) / len(rates), min(rates.values())
    print(f"mean {mean:.3f} (at least 0.80), lowest {lowest:.3f} (at least 0.60), {len(results)} episodes")
    return int(mean < 0.80 or lowest < 0.60 or short)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/tiny")))
