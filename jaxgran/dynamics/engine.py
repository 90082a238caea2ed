"""Selects the engine that advances a flow, by the name that the flow gives or by backend, precision and solver.

================  ====================================  ============================================================
engine            for                                   needs
================  ====================================  ============================================================
machine_code      processors                            float64, the default solver, no ``vmap`` with a named axis
thread_block      NVIDIA GPUs                           at most 1024 grains, the default solver
jax               everything else, and as reference     nothing: every backend, precision, solver and derivative
auto              whatever is asked for                 nothing: the one of the backend where it can, or else jax
================  ====================================  ============================================================

All engines solve the same steps to the same tolerance. Derivatives, ``observe`` and steps without free flight are in
the engine jax alone. With "auto" it takes them; an engine that is named and cannot do what is asked is refused.
"""

import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp

from jaxgran.model.checks import InputError
from jaxgran.model.control_flow import AXIS, in_batch
from jaxgran.model.flow import Engine, ShearFlow
from jaxgran.model.state import State

MOST_GRAINS = 1024  # of a thread block: the threads that it can have
_SOLVER = ShearFlow.__dataclass_fields__["solver"].default
_OF_PLATFORM: dict[str, Engine] = {"cpu": "machine_code", "gpu": "thread_block"}
_SOLVERS = {"machine_code": "gauss-seidel, barzilai-borwein where stiff", "thread_block": "barzilai-borwein"}


def select_engine(flow: ShearFlow, state: State | None = None, besides: str = "") -> Engine:
    """Selects the engine for the backend, precision and solver: ``machine_code``, ``thread_block`` or ``jax``.

    Args:
      flow: what counts is its engine, its solver and its number of grains; it may be a batch.
      state: what counts is its precision; None for the one that JAX makes numbers in.
      besides: what is asked of the advance that the engine jax alone can do, in words; empty for nothing.

    Raises:
      InputError: the flow names an engine that cannot do what is asked.
    """
    if flow.engine == "jax":
        return "jax"
    device = _device()
    engine = _OF_PLATFORM.get(device.platform) if flow.engine == "auto" else flow.engine
    if engine is None:
        return "jax"
    obstacle = _obstacle(engine, flow, state, besides, device)
    if obstacle is None and engine == "thread_block":
        obstacle = _kernel_obstacle(flow, state, device)
    if obstacle is None:
        return engine
    if flow.engine == "auto":
        return "jax"
    where, why = obstacle
    raise InputError(f"engine must be auto or jax {where}, not {engine}: {why}.")


def solver_in_use(engine: Engine, solver: str) -> str:
    """What solves the contacts where an engine runs a flow with a solver; isolated pairs have a closed form.

    Examples:
      >>> solver_in_use("jax", "jacobi")
      'jacobi'
      >>> solver_in_use("machine_code", "barzilai-borwein")
      'gauss-seidel, barzilai-borwein where stiff'
    """
    return _SOLVERS.get(engine, solver)


def _obstacle(
    engine: Engine, flow: ShearFlow, state: State | None, besides: str, device: Any
) -> tuple[str, str] | None:
    """Where an engine cannot do what is asked, and why, in words; None where it can, if its kernel runs."""
    dtypes = _dtypes(state)
    if _OF_PLATFORM.get(device.platform) != engine:
        made_for = "processors" if engine == "machine_code" else "NVIDIA GPUs"
        return f"on a {device.platform.upper()}", f"it is made for {made_for}"
    if besides:
        return f"with {besides}", "only the engine jax does that"
    if flow.solver != _SOLVER:
        return f"with the solver {flow.solver}", "it has a contact solve of its own"
    if len(dtypes) > 1:
        return "where the numbers of a state differ in precision", "it computes in one"
    if engine == "machine_code" and dtypes != {jnp.dtype(jnp.float64)}:
        return f"in {next(iter(dtypes))}", 'it computes in float64 (jax.config.update("jax_enable_x64", True))'
    if engine == "machine_code" and in_batch():
        return f"in a vmap with the axis name {AXIS!r}", "it advances one replica after another, as in jax.lax.map"
    if engine == "thread_block" and flow.grains > MOST_GRAINS:
        return f"with more than {MOST_GRAINS} grains", "every grain has a thread of one block"
    return None


def _kernel_obstacle(flow: ShearFlow, state: State | None, device: Any) -> tuple[str, str] | None:
    """The same of the kernel for GPUs, which is tried; where none was asked for by name, a warning says so."""
    dtype = next(iter(_dtypes(state)))
    problem = _kernel_problem(flow.grains, dtype, device, jax.config.read("jax_enable_x64"))
    if not problem:
        return None
    if flow.engine == "auto":
        _warn_once(f"flows take the engine jax: the kernel for GPUs does not run here ({problem}).")
    return "here", f"the kernel for GPUs does not run ({problem})"


def _dtypes(state: State | None) -> set[jnp.dtype]:
    return {jnp.dtype(jnp.result_type(float))} if state is None else {x.dtype for x in jax.tree.leaves(state)}


def _device() -> Any:
    """The device that JAX computes on by default."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]  # of ``jax.default_device``
    return jax.devices(device)[0] if device is None or isinstance(device, str) else device


@cache
def _kernel_problem(grains: int, dtype: jnp.dtype, device: Any, x64: bool) -> str:
    """Why the kernel does not compile or keep the laws of contacts on a device, empty where it does: tried once."""

    def trial() -> None:
        from jaxgran.dynamics.thread_block import kernel

        with jax.default_device(device), jax.enable_x64(x64):
            kernel.trial(grains, dtype)

    try:
        with ThreadPoolExecutor(1) as other:  # what is being traced here is not traced there
            other.submit(trial).result()
    except Exception as error:  # of a compiler, a driver or a device: there is no saying which
        return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    return ""


@cache
def _warn_once(words: str) -> None:
    warnings.warn(words, stacklevel=2)
