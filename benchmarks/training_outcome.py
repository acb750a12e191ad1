"""Success rates of `make train`: mean at least 0.80, no task below 0.60, 25 unseen episodes each (seconds, after it).

Usage: python -m benchmarks.training_outcome [RUN]
"""

import sys
from pathlib import Path

from dsvla_jax.evaluation.report import print_table
from dsvla_jax.evaluation.results import latest, macro_mean, read_results, success_rates


def main(run: Path) -> int:
    results = latest(read_results(run / "eval"), lambda conditions: conditions.physics == "mujoco")
    print_table(results)
    rates = success_rates(results)
    mean, lowest = macro_mean(rates), min(rate.rate for rate in rates)
    short = any(rate.trials < 25 for rate in rates)
    print(f"mean {mean:.3f} (at least 0.80), lowest {lowest:.3f} (at least 0.60), {len(results)} episodes")
    return int(mean < 0.80 or lowest < 0.60 or short)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/tiny")))
