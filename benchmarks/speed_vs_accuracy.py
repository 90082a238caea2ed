"""Speed against accuracy: the charts of the contact solve, of whole runs, and of batches.

python -m benchmarks speed_vs_accuracy                    # all charts
python -m benchmarks speed_vs_accuracy --quick            # all, smaller
python -m benchmarks speed_vs_accuracy --only throughput  # one of methods, runs, throughput
"""

import time

from benchmarks import method_chart, run_chart, throughput_chart
from benchmarks.output import Output

CHARTS = {"methods": method_chart.chart, "runs": run_chart.chart, "throughput": throughput_chart.chart}


def run(output: Output, only: str | None = None) -> None:
    """Make all charts, or one."""
    for name in CHARTS if only is None else [only]:
        start = time.perf_counter()
        CHARTS[name](output)
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
