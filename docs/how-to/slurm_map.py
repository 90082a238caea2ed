"""Run a map on a cluster: start Dask workers through Slurm, or on this machine where there is none,
and map on them.

    python docs/how-to/slurm_map.py --workers 32 --walltime 04:00:00 -- --preset paper --output
    paper.nc --resume

What follows ``--`` goes to ``jaxgran map``. Run it where it may live as long as the map, such as a
login node's terminal multiplexer or a small job of its own; when it is cut off, the same line goes
on where it was. With Slurm it needs ``pip install dask-jobqueue``. Scheduler and dashboard listen
to this machine alone where the workers run here too, and to the network that the workers reach it
by where they do not.
"""

import argparse
import shutil
import subprocess
import sys


def main() -> int:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("--workers", type=int, default=2, help="processes, a core each")
    arguments.add_argument("--walltime", default="04:00:00", help="of each job of Slurm")
    arguments.add_argument("--memory", default="4GB", help="of each worker")
    arguments.add_argument("--queue", help="partition of Slurm")
    arguments.add_argument("map", nargs="*", help="options of jaxgran map, after --")
    chosen = arguments.parse_args()
    with started(chosen) as cluster:
        cluster.scale(chosen.workers)
        print(f"scheduler at {cluster.scheduler_address}", file=sys.stderr)
        command = [
            sys.executable,
            "-m",
            "jaxgran",
            "map",
            "--scheduler",
            cluster.scheduler_address,
            *chosen.map,
        ]
        return subprocess.run(command).returncode


def started(chosen: argparse.Namespace):
    """A cluster of Slurm jobs with a worker each, or of processes of this machine."""
    if shutil.which("sbatch") is None:
        from dask.distributed import LocalCluster

        return LocalCluster(
            n_workers=0, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        )
    from dask_jobqueue import SLURMCluster

    return SLURMCluster(
        cores=1,
        processes=1,
        memory=chosen.memory,
        walltime=chosen.walltime,
        queue=chosen.queue,
        death_timeout=600,
    )


if __name__ == "__main__":
    raise SystemExit(main())
