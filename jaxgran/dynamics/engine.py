"""Selects the engine that advances a flow: by name, or for the backend, precision and solver.

================  ====================================  ============================================================
engine            for                                   needs
================  ====================================  ============================================================
numba      processors                            float64, the default solver, no ``vmap`` with a named axis
pallas      NVIDIA GPUs                           at most 1024 grains, the default solver
jax               everything else, and as reference     nothing: every backend, precision, solver and derivative
auto              every flow                            nothing: the engine of the backend if possible, or else jax
================  ====================================  ============================================================

All engines solve the same steps to the same tolerance. Derivatives and steps without free flight run in the engine
"jax" only, and ``observe`` in it and in the numba engine. "auto" selects an engine that can. A named engine that cannot
raises an InputError.
"""

import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp

from jaxgran.model.checks import InputError
from jaxgran.model.choices import Engine
from jaxgran.model.control_flow import AXIS, in_batch
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State

MOST_GRAINS = 1024  # of a thread block: one thread a grain, and CUDA allows 1024 threads
_DEFAULT_SOLVER = ShearFlow.__dataclass_fields__["solver"].default
_ENGINE_OF_PLATFORM: dict[str, Engine] = {"cpu": "numba", "gpu": "pallas"}
_SINGLE_PRECISION = (
    "JAX computes in single precision, in which flows take the engine jax, several times slower than the numba engine: "
    'begin with jax.config.update("jax_enable_x64", True).'
)
_OPTIONS_OF_ENGINE = {"numba": ("observe",)}
_SOLVER_OF_ENGINE = {"numba": "gauss-seidel, barzilai-borwein where stiff", "pallas": "barzilai-borwein"}


def select_engine(flow: ShearFlow, state: State | None = None, option: str = "") -> Engine:
    """Selects the engine for the backend, precision and solver: ``numba``, ``pallas`` or ``jax``.

    Args:
      flow: gives the engine, the solver and the number of grains; it may be a batch.
      state: gives the precision; None for JAX's default precision.
      option: name of an option that not all engines have; "" if there is none.

    Raises:
      InputError: the flow names an engine that cannot do this.
    """
    if flow.engine == "jax":
        return "jax"
    device = _device()
    engine = _ENGINE_OF_PLATFORM.get(device.platform) if flow.engine == "auto" else flow.engine
    if engine is None:
        return "jax"
    option = "" if option in _OPTIONS_OF_ENGINE.get(engine, ()) else option
    obstacle = _obstacle(engine, flow, state, option, device)
    if obstacle is None and engine == "pallas":
        obstacle = _kernel_obstacle(flow, state, device)
    if obstacle is None:
        return engine
    if flow.engine == "auto":
        if state is not None and engine == "numba" and _only_precision_is_missing(flow, option):
            _warn_once(_SINGLE_PRECISION)
        return "jax"
    where, why = obstacle
    raise InputError(f"engine must be auto or jax {where}, not {engine}: {why}.")


def solver_in_use(engine: Engine, solver: str) -> str:
    """Name of the method that solves the contacts in an engine; isolated pairs have a closed form in all of them.

    Examples:
      >>> solver_in_use("jax", "jacobi")
      'jacobi'
      >>> solver_in_use("numba", "barzilai-borwein")
      'gauss-seidel, barzilai-borwein where stiff'
    """
    return _SOLVER_OF_ENGINE.get(engine, solver)


def _obstacle(engine: Engine, flow: ShearFlow, state: State | None, option: str, device: Any) -> tuple[str, str] | None:
    """When an engine cannot advance a flow, and why, as two parts of a sentence; None if it can."""
    if _ENGINE_OF_PLATFORM.get(device.platform) != engine:
        made_for = "processors" if engine == "numba" else "NVIDIA GPUs"
        return f"on a {device.platform.upper()}", f"it is made for {made_for}"
    if option:
        others = [name for name, options in _OPTIONS_OF_ENGINE.items() if option in options]
        return f"with {option}", f"only the engine {' or '.join([*others, 'jax'])} does that"
    if flow.solver != _DEFAULT_SOLVER:
        return f"with the solver {flow.solver}", "it has a contact solve of its own"
    if engine == "numba" and _dtype(state) != jnp.float64:
        return f"in {_dtype(state)}", 'it computes in float64 (jax.config.update("jax_enable_x64", True))'
    if engine == "numba" and in_batch():
        return f"in a vmap with the axis name {AXIS!r}", "it advances one replica after another, as in jax.lax.map"
    if engine == "pallas" and flow.grains > MOST_GRAINS:
        return f"with more than {MOST_GRAINS} grains", "every grain has a thread of one block"
    return None


def _only_precision_is_missing(flow: ShearFlow, option: str) -> bool:
    """Whether the numba engine would advance the flow if double precision were switched on."""
    other = option or flow.solver != _DEFAULT_SOLVER or in_batch()
    return not other and not jax.config.read("jax_enable_x64")


def _kernel_obstacle(flow: ShearFlow, state: State | None, device: Any) -> tuple[str, str] | None:
    """The obstacle that a trial of the GPU kernel finds; with the engine "auto", a warning reports it."""
    problem = _kernel_problem(flow.grains, _dtype(state), device, jax.config.read("jax_enable_x64"))
    if not problem:
        return None
    if flow.engine == "auto":
        _warn_once(f"flows take the engine jax: the kernel for GPUs does not run here ({problem}).")
    return "here", f"the kernel for GPUs does not run ({problem})"


def _dtype(state: State | None) -> jnp.dtype:
    return jnp.dtype(jnp.result_type(float)) if state is None else state.positions.dtype


def _device() -> Any:
    """The device that JAX computes on by default."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]  # set by ``jax.default_device``
    return jax.devices(device)[0] if device is None or isinstance(device, str) else device


@cache
def _kernel_problem(grains: int, dtype: jnp.dtype, device: Any, x64: bool) -> str:
    """Why the kernel does not compile on a device or breaks the contact law there; "" if it works. Tried once."""

    def trial() -> None:
        from jaxgran.dynamics.pallas_engine import kernel

        with jax.default_device(device), jax.enable_x64(x64):
            kernel.trial(grains, dtype)

    try:
        with ThreadPoolExecutor(1) as other:  # another thread: the trial must not become part of a trace
            other.submit(trial).result()
    except Exception as error:  # a compiler, a driver or a device may fail in any way
        return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    return ""


@cache
def _warn_once(words: str) -> None:
    warnings.warn(words, stacklevel=2)
