"""All benchmarks: what each asks, how long it takes, what it writes, and its own options. Imports
nothing heavy.
"""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Option:
    """An option of one benchmark, given to its ``run`` under the same name; without it the default
    there holds.
    """

    name: str
    help: str
    kind: type = str
    choices: tuple[str | int, ...] | None = None


@dataclass(frozen=True)
class Benchmark:
    """A benchmark: its module has a function ``run`` that takes an ``Output`` and the options.

    ``minutes`` are those of a full and of a quick run on two cores of a desktop processor.
    ``files`` are the committed results in ``benchmarks/results``. ``one_core`` says that JAX is
    held to one core.
    """

    name: str
    question: str
    minutes: tuple[float, float]
    files: tuple[str, ...] = ()
    options: tuple[Option, ...] = ()
    one_core: bool = False
    module: str = ""

    @property
    def module_name(self) -> str:
        return f"benchmarks.{self.module or self.name}"


BENCHMARKS = (
    Benchmark(
        "validation",
        "Are stresses, temperature and force ratio those of independent programs?",
        (25, 1),
        ("validation.json", "validation.png"),
    ),
    Benchmark(
        "paper",
        "Where in the plane are binary collisions all there is?",
        (20, 0.5),
        (
            "paper.nc",
            *("paper_curves.png", "paper_contours.png", "paper_theory.png", "paper_factors.png"),
            "paper_mean_mass.json",
        ),
        (Option("--mean-mass", "compare with the ratio by the paper's mass", bool),),
    ),
    Benchmark(
        "reference_map",
        "What are stresses, temperatures and the dissipation rate of large systems over the whole "
        "plane?",
        (180, 1),
        (
            "reference.nc",
            *(
                f"reference_{name}.nc"
                for name in (
                    *("between", "dense", "dissipative", "sizes_loose"),
                    *("sizes_dense", "check_small", "check_large", "coarse"),
                )
            ),
        ),
        (
            Option(
                "--seeds",
                "number of seeds of the first four parts, those that are kept included",
                int,
            ),
            Option("--first-seed", "the first of these seeds", int),
            Option(
                "--part",
                "the plane, flows between loose and dense ones, dense or dissipative ones of more "
                "grains, flows of several sizes, those that check the law of the size, or a coarse "
                "step",
                choices=("plane", "between", "dense", "dissipative", "sizes", "check", "coarse"),
            ),
            Option("--folder", "where the maps that are done are kept", Path),
        ),
    ),
    Benchmark(
        "reference_runs",
        "What are stresses and temperatures at random points that no table of `jg.validity` has "
        "seen?",
        (5, 0.5),
        ("reference_runs.json", "reference_runs_large.json"),
        (Option("--part", "random points, or large flows", choices=("random", "large")),),
    ),
    Benchmark(
        "reference",
        "Which table does `jg.validity` answer from, and do its intervals hold?",
        (1, 1),
        ("reference.json", "reference.png"),
        one_core=True,
    ),
    Benchmark(
        "dissipation",
        "How much less than Enskog's is the dissipation rate, and does a theory with a law of it "
        "predict other flows?",
        (2, 1),
        ("dissipation.json", "dissipation.png"),
    ),
    Benchmark(
        "flow_picture",
        "What do the forces between grains look like at restitutions 0.9 and 0.1?",
        (2, 1),
        ("flow.json", "flow.png", "flow.gif"),
    ),
    Benchmark(
        "step_cost",
        "How long does a step of a replica take, beside a numba loop made for one purpose?",
        (1, 0.5),
        ("step_cost.json",),
        (Option("--repeats", "timed pairs of each point", int),),
        one_core=True,
    ),
    Benchmark(
        "scaling",
        "How do time and memory grow with the number of grains, and time with the time step?",
        (7, 2),
        ("scaling.json", "scaling.png"),
        (Option("--grains", "one flow of so many grains, printed as JSON", int),),
    ),
    Benchmark(
        "many_replicas",
        "Which way to advance many replicas is the fastest, and what does it take to compile and "
        "to hold?",
        (2, 1),
        ("many_replicas.json",),
    ),
    Benchmark(
        "device_batch",
        "How many replica-steps per second does this device make, beside one core of the numba "
        "loop?",
        (2, 1),
        ("device_batch_gpu.json",),
        (Option("--engine", "that of the device", choices=("auto", "numba")),),
    ),
    Benchmark(
        "speed_vs_accuracy",
        "What does accuracy cost, here and in other programs?",
        (60, 4),
        ("speed_vs_accuracy.json", "speed_vs_accuracy.png"),
        one_core=True,
        module="peers.compare",
    ),
    Benchmark(
        "solvers",
        "How many iterations and how much time does a contact solve take, by which method?",
        (1, 0.5),
        ("solvers.json",),
        one_core=True,
    ),
    Benchmark(
        "startup",
        "How long does a command take from the prompt to its end?",
        (3, 1),
        ("startup.json",),
    ),
    Benchmark(
        "timestep_study",
        "What becomes of the force ratio as the time step vanishes?",
        (2.5, 1),
        ("timestep_study.json", "timestep_study.png"),
        one_core=True,
    ),
    Benchmark(
        "timestep_error",
        "What of a sample foretells the error of its pressure from the time step?",
        (30, 0.5),
        ("timestep_error.json",),
        one_core=True,
    ),
    Benchmark(
        "size_study",
        "What does the number of grains do to stresses, temperature and force ratio?",
        (20, 1),
        ("size_study.json", "size_study.png", "size_study_waves.png"),
        (Option("--folder", "where the flows that are done are kept", Path),),
    ),
    Benchmark(
        "size_limits",
        "What are the averages of a large system, and by which law are they approached?",
        (0.25, 0.25),
        ("size_limits.json",),
    ),
    Benchmark(
        "stability",
        "Where do methods fail, from loose and elastic to dense and dissipative flows?",
        (150, 2),
        ("stability.json", "stability.png"),
        (Option("--folder", "where the flows that are done are kept", Path),),
        one_core=True,
    ),
)
