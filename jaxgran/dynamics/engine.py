"""The engines that advance a flow, and the choice of one for the backend, precision and solver.

=========  =====================================  ==========================================================
engine     for                                    needs
=========  =====================================  ==========================================================
Numba      processors                             float64, the default solver
Jax        everything else, and as the reference  nothing: every backend, precision, solver and derivative
=========  =====================================  ==========================================================

Both engines solve the same steps to the same tolerance, and differ in speed and rounding. Derivatives and steps without
free flight run in the engine ``Jax`` only. Where no engine is given, ``Numba`` is taken on a processor if it can do
what is asked for, and otherwise ``Jax``. A given engine that cannot raises an InputError.
"""

import warnings
from dataclasses import dataclass, field
from functools import cache
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jaxgran.cache.folder import use_cache
from jaxgran.contact.projected_methods import (
    DEFAULT_SOLVER,
    BarzilaiBorwein,
    ProjectedMethod,
    require_solver,
    solver_name,
)
from jaxgran.environment import precision
from jaxgran.model.checks import InputError, short_repr
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State

_SINGLE_PRECISION = (
    "JAX computes in single precision, in which flows take the engine jax, several times slower than the numba engine: "
    'begin with jax.config.update("jax_enable_x64", True).'
)


@dataclass(frozen=True)
class Jax:
    """The engine in JAX: every backend, precision and solver, and derivatives.

    The replicas of a batch advance one after another on a processor, and in lockstep on an accelerator.

    Examples:
      >>> Jax()
      Jax()
    """

    name: ClassVar[str] = "jax"


@dataclass(frozen=True)
class Numba:
    """The engine for processors, compiled by numba: float64 and the solver ``BarzilaiBorwein`` only.

    It solves clusters one by one, by Gauss–Seidel sweeps and then by the method of the solver, to its ``tolerance`` and
    within its ``max_steps``. Under ``jax.vmap`` replicas advance on all cores, with the same bits on any number of
    threads; the environment variable ``NUMBA_NUM_THREADS`` sets their number. ``jax.lax.map`` takes one at a time.

    Examples:
      >>> Numba()
      Numba()
    """

    name: ClassVar[str] = "numba"
    platform: ClassVar[str] = "cpu"
    options: ClassVar[tuple[str, ...]] = ("observe",)
    solver: ClassVar[str] = "gauss-seidel, barzilai-borwein where stiff"


Engine = Jax | Numba


def engine_named(name: str) -> Engine | None:
    """The engine by its name on the command line and in files; None for "auto".

    Raises:
      InputError: no engine has this name.

    Examples:
      >>> engine_named("numba"), engine_named("auto")
      (Numba(), None)
    """
    engines: dict[str, Engine | None] = {"auto": None, **{kind.name: kind() for kind in (Jax, Numba)}}
    if str(name) not in engines:
        raise InputError(f"engine must be {', '.join(engines)}, not {short_repr(name)}.")
    return engines[str(name)]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Numerics:
    """How a flow is computed, as one value: the solver of its contacts, and the engine, None for automatic."""

    solver: ProjectedMethod = DEFAULT_SOLVER
    engine: Engine | None = field(default=None, metadata={"static": True})


DEFAULT_NUMERICS = Numerics()


def checked_numerics(solver: Any, engine: Any) -> Numerics:
    """Solver and engine as one value; InputError unless they are a projected method, and an engine or None."""
    use_cache()  # what is checked here is compiled next
    require_solver(solver)
    if engine is not None and not isinstance(engine, Engine):
        raise InputError(f"engine must be jg.Jax(), jg.Numba() or None, not {short_repr(engine)}.")
    return Numerics(solver, engine)


def select_engine(flow: ShearFlow, numerics: Numerics, state: State | None = None, option: str = "") -> Engine:
    """The engine that advances a flow, for the backend, precision and solver.

    Args:
      flow: gives the number of grains; it may be a batch.
      numerics: the solver, and the engine that was asked for.
      state: gives the precision; None for JAX's default precision.
      option: name of an option that not all engines have; "" if there is none.

    Raises:
      InputError: the engine that was asked for cannot do this.
    """
    requested = numerics.engine
    if isinstance(requested, Jax):
        return requested
    device = default_device()
    option = "" if option in Numba.options else option
    why = _why_unsupported(numerics.solver, state, option, device)
    if why is None:
        return Numba()
    if requested is None:
        other = option or not _is_default(numerics.solver) or device.platform != Numba.platform
        if state is not None and not other and precision() == "float32":
            _warn_once(_SINGLE_PRECISION)
        return Jax()
    where, reason = why
    raise InputError(f"engine must be jax or chosen automatically {where}, not {Numba.name}: {reason}.")


def in_lockstep() -> bool:
    """Whether the replicas of a batch advance together, as one array program that waits for its slowest replica.

    They do on an accelerator. On a processor they advance one after another, which is faster.
    """
    return default_device().platform != "cpu"


def solver_in_use(engine: Engine, solver: ProjectedMethod) -> str:
    """Name of the method that solves the contacts in an engine; isolated pairs have a closed form in both.

    Examples:
      >>> solver_in_use(Jax(), DEFAULT_SOLVER), solver_in_use(Numba(), DEFAULT_SOLVER)
      ('barzilai-borwein', 'gauss-seidel, barzilai-borwein where stiff')
    """
    return solver_name(solver) if isinstance(engine, Jax) else engine.solver


def _is_default(solver: ProjectedMethod) -> bool:
    """Whether this is the method that both engines have, with any tolerance."""
    return type(solver) is BarzilaiBorwein


def _why_unsupported(solver: ProjectedMethod, state: State | None, option: str, device: Any) -> tuple[str, str] | None:
    """When the engine ``Numba`` cannot advance a flow, and why, as two parts of a sentence; None if it can."""
    if device.platform != Numba.platform:
        return f"on a {device.platform.upper()}", "it is made for processors"
    if option:
        return f"with {option}", f"only the engine {Jax.name} does that"
    if not _is_default(solver):
        return f"with the solver {solver_name(solver)}", "it has a contact solve of its own"
    if _dtype(state) != jnp.float64:
        return f"in {_dtype(state)}", 'it computes in float64 (jax.config.update("jax_enable_x64", True))'
    return None


def _dtype(state: State | None) -> jnp.dtype:
    return jnp.dtype(jnp.result_type(float)) if state is None else state.positions.dtype


def default_device() -> Any:
    """The device that JAX computes on by default."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]  # set by ``jax.default_device``
    return jax.devices(device)[0] if device is None or isinstance(device, str) else device


@cache
def _warn_once(message: str) -> None:
    warnings.warn(message, stacklevel=2)
