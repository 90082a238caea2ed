"""The engines that advance a flow, and the choice of one for the device, precision, solver and
options.

Both engines solve the same steps to the same tolerance, and differ in speed and rounding.
``LIMITS`` is the table of what each can do. Where no engine is given, ``Numba`` is taken if it can
do what is asked for, and otherwise ``Jax``. A given engine that cannot raises an InputError.
"""

import warnings
from dataclasses import dataclass, field
from functools import cache
from typing import Any, ClassVar, NamedTuple

import jax

from jaxgran.contact.projected_methods import (
    DEFAULT_SOLVER,
    ProjectedMethod,
    require_solver,
    solver_name,
)
from jaxgran.environment import default_device, precision
from jaxgran.model.checks import InputError, short_repr
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State

_SINGLE_PRECISION = (
    "JAX computes in single precision, in which flows take the engine jax, several times slower "
    "than the numba engine: "
    'begin with jax.config.update("jax_enable_x64", True).'
)


@dataclass(frozen=True)
class Jax:
    """The engine in JAX: every backend, precision and solver, and derivatives.

    The replicas of a batch advance one by one on a processor, in lockstep on an accelerator.

    Examples:
      >>> Jax()
      Jax()
    """

    name: ClassVar[str] = "jax"


@dataclass(frozen=True)
class Numba:
    """The engine for processors, compiled by numba: float64 and the solver ``BarzilaiBorwein``
    only.

    It solves clusters one by one, by Gauss–Seidel sweeps and then by the method of the solver, to
    its ``tolerance`` and within its ``max_steps``. Under ``jax.vmap`` replicas advance on all
    cores, with the same bits on any number of threads; the environment variable
    ``NUMBA_NUM_THREADS`` sets their number. ``jax.lax.map`` takes one at a time.

    Examples:
      >>> Numba()
      Numba()
    """

    name: ClassVar[str] = "numba"
    solver: ClassVar[str] = "gauss-seidel, barzilai-borwein where stiff"


Engine = Jax | Numba


class Needs(NamedTuple):
    """What a flow needs of an engine; in ``LIMITS`` what an engine accepts, None for everything."""

    device: Any
    precision: Any
    solver: Any
    option: Any


_WORDS = Needs("on the device {}", "in {}", "with the solver {}", "with {}")
LIMITS: dict[type, Needs] = {
    #            device    precision     solver                 option
    Numba: Needs(("cpu",), ("float64",), ("barzilai-borwein",), ("", "observe")),
    Jax: Needs(None, None, None, None),
}


def engine_named(name: str) -> Engine | None:
    """The engine by its name on the command line and in files; None for "auto".

    Raises:
      InputError: no engine has this name.

    Examples:
      >>> engine_named("numba"), engine_named("auto")
      (Numba(), None)
    """
    engines: dict[str, Engine | None] = {
        "auto": None,
        **{kind.name: kind() for kind in (Jax, Numba)},
    }
    if str(name) not in engines:
        raise InputError(f"engine must be {', '.join(engines)}, not {short_repr(name)}.")
    return engines[str(name)]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Numerics:
    """How a flow is computed, as one value: the solver of its contacts, and the engine, None for
    automatic.
    """

    solver: ProjectedMethod = DEFAULT_SOLVER
    engine: Engine | None = field(default=None, metadata={"static": True})


DEFAULT_NUMERICS = Numerics()


def checked_numerics(solver: Any, engine: Any) -> Numerics:
    """Solver and engine as one value; InputError unless they are a projected method, and an engine
    or None.
    """
    require_solver(solver)
    if engine is not None and not isinstance(engine, Engine):
        raise InputError(f"engine must be jg.Jax(), jg.Numba() or None, not {short_repr(engine)}.")
    return Numerics(solver, engine)


def select_engine(
    flow: ShearFlow, numerics: Numerics, state: State | None = None, option: str = ""
) -> Engine:
    """The engine that was asked for, or else the first of ``LIMITS`` that can advance a flow.

    Args:
      flow: gives the number of grains; it may be a batch.
      numerics: the solver, and the engine that was asked for.
      state: gives the precision; None for JAX's default precision.
      option: name of an option that not all engines have; "" if there is none.

    Raises:
      InputError: the engine that was asked for cannot do this, or JAX computes in single precision
        and the state is in double precision.
    """
    engine = numerics.engine or Numba()
    dtype = precision() if state is None else str(state.positions.dtype)
    if dtype == "float64" != precision():
        raise InputError(
            "state must be of the precision in which JAX computes, float32, not float64: begin "
            'with jax.config.update("jax_enable_x64", True).'
        )
    needs = Needs(default_device().platform, dtype, solver_name(numerics.solver), option)
    limits = LIMITS[type(engine)]
    unmet = {
        name: words.format(value)
        for name, words, value, accepted in zip(Needs._fields, _WORDS, needs, limits, strict=True)
        if accepted is not None and value not in accepted
    }
    if not unmet:
        return engine
    if numerics.engine is None:
        if state is not None and [*unmet] == ["precision"] and precision() == "float32":
            _warn_once(_SINGLE_PRECISION)
        return Jax()
    wrong = " and ".join(unmet.values())
    accepted = [" or ".join(value or "no option" for value in values) for values in limits]
    runs = ", ".join(words.format(values) for words, values in zip(_WORDS, accepted, strict=True))
    hint = ' (jax.config.update("jax_enable_x64", True))' if "precision" in unmet else ""
    raise InputError(
        f"engine must be jax or chosen automatically {wrong}, not {engine.name}: it runs {runs} "
        f"only{hint}."
    )


def in_lockstep() -> bool:
    """Whether the replicas of a batch advance together, as one array program that waits for its
    slowest replica.

    They do on an accelerator. On a processor each advances by itself, which is faster.
    """
    return default_device().platform != "cpu"


def solver_in_use(engine: Engine, solver: ProjectedMethod) -> str:
    """Name of the method that solves the contacts in an engine; isolated pairs have a closed form
    in both.

    Examples:
      >>> solver_in_use(Jax(), DEFAULT_SOLVER), solver_in_use(Numba(), DEFAULT_SOLVER)
      ('barzilai-borwein', 'gauss-seidel, barzilai-borwein where stiff')
    """
    return solver_name(solver) if isinstance(engine, Jax) else engine.solver


@cache
def _warn_once(message: str) -> None:
    warnings.warn(message, stacklevel=2)
