"""Speed against accuracy: the charts of whole runs and of batches.

python -m benchmarks speed_vs_accuracy                    # both charts
python -m benchmarks speed_vs_accuracy --quick            # both, smaller
python -m benchmarks speed_vs_accuracy --only throughput  # one of runs, throughput
"""

import time

from benchmarks import run_chart, throughput_chart
from benchmarks.output import Output

CHARTS = {"runs": run_chart.chart, "throughput": throughput_chart.chart}


def run(output: Output, only: str | None = None) -> None:
    """Make both charts, or one."""
    for name in CHARTS if only is None else [only]:
        start = time.perf_counter()
        CHARTS[name](output)
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
