"""Set-up of every test: programs compiled in earlier runs are reused, numbers are float64,
promotion is strict.

Programs are kept in ``.pytest_cache/jaxgran``, or in the folder that ``JAXGRAN_TEST_CACHE`` names,
by the package's own caches. Both folders may be deleted at any time.
"""

import os
import sys
from pathlib import Path

FOLDER = (
    os.environ.get("JAXGRAN_TEST_CACHE") or Path(__file__).parents[1] / ".pytest_cache" / "jaxgran"
)
os.environ["XDG_CACHE_HOME"] = str(FOLDER)  # also for the processes that tests start
# Most of the time of a run is compilation, which takes a fifth as long with less optimisation by
# the older emitter, and less of a processor on one thread.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_parallel_codegen_split_count=1",
)
sys.modules["colorama"] = None  # with it numba replaces sys.stderr while it compiles
os.environ.pop("COLUMNS", None)  # pytest-xdist sets it, and tables would take that width

import hypothesis  # noqa: E402
import jax  # noqa: E402

from jaxgran.cache.folder import use_cache  # noqa: E402

pytest_plugins = ["flows"]

use_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# the same examples at any speed
hypothesis.settings.register_profile("tests", deadline=None, derandomize=True)
hypothesis.settings.load_profile("tests")
