"""Speed against accuracy: the charts of the contact solve, of whole runs, and of batches.

python benchmarks/speed_vs_accuracy.py                    # all charts
python benchmarks/speed_vs_accuracy.py --quick            # all, smaller
python benchmarks/speed_vs_accuracy.py --only throughput  # one of methods, runs, throughput
"""

import argparse
import os
import time
from importlib import import_module
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

import jax

CHARTS = {"methods": "method_chart", "runs": "run_chart", "throughput": "throughput_chart"}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--quick", action="store_true", help="smaller charts")
    arguments.add_argument("--only", choices=CHARTS, help="one chart instead of all")
    arguments.add_argument("--output", type=Path, default=Path(__file__).parent / "results")
    chosen = arguments.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name in [chosen.only] if chosen.only else CHARTS:
        start = time.perf_counter()
        import_module(CHARTS[name]).chart(chosen.quick, chosen.output)
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
