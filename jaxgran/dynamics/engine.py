"""The engines that advance a flow, and the choice of one for the device, the precision and the
solver.

Both engines solve the same steps to the same tolerance, and differ in speed and rounding. An engine
is an object with a name: ``refuses`` says what it cannot do, ``solver_in_use`` which method solves
its contacts, and ``advance`` advances one replica. Where none is given, ``Numba`` is taken if it
can do what is asked for, and otherwise ``Jax``.
"""

import warnings
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, ClassVar

import jax
from jaxtyping import Array, Int

from jaxgran.contact.projected_methods import (
    DEFAULT_SOLVER,
    BarzilaiBorwein,
    ProjectedMethod,
    require_solver,
    solver_name,
)
from jaxgran.dynamics.batching import with_forward_derivative, with_own_batching
from jaxgran.dynamics.jax_engine import advance_by_jax
from jaxgran.dynamics.numba_engine.observed import advance_by_numba
from jaxgran.dynamics.numba_engine.team.handler import has_cuda
from jaxgran.dynamics.observer import Observe, uses_traced_values
from jaxgran.dynamics.tally import Tally
from jaxgran.environment import default_device, on_processor, precision
from jaxgran.model.checks import InputError, refused, require_flag, require_whole
from jaxgran.model.choices import MAX_STEPS
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import ENABLE_X64, State


@dataclass(frozen=True)
class Jax:
    """The engine in JAX: every backend, precision and solver, and derivatives.

    The replicas of a batch advance one by one on a processor, in lockstep on an accelerator and
    with ``events``.

    Forward-mode derivatives (``jax.jvp``, ``jax.jacfwd``) need no argument. Reverse-mode
    derivatives (``jax.grad``, ``jax.vjp``) need the number of ``events``. Reverse mode stores the
    state and the lists of every event, about 0.6 kB a grain, and computes contacts and impulses
    again in the backward pass.

    Args:
      events: number of visited steps of an advance, or of each of its blocks, for a loop of fixed
        length; ``2 * steps + 1`` is always enough, and ``count_events`` counts them. If they are
        too few, the status is ``capacity``, and numbers and derivatives are NaN. None visits as
        many as needed.
      moving_contacts: whether derivatives include the shift of the contacts in time, see
        ``dynamics.jax_engine``. The trajectory does not change.
      free_flight: True jumps over steps without an approaching contact; False visits every step.
        The trajectory is the same.

    Examples:
      >>> Jax(events=400)
      Jax(events=400, moving_contacts=False, free_flight=True)
    """

    events: int | None = None
    moving_contacts: bool = False
    free_flight: bool = True
    name: ClassVar[str] = "jax"

    def __post_init__(self) -> None:
        if self.events is not None:
            require_whole("events", self.events, 1, MAX_STEPS, "the most steps of an advance")
        require_flag("moving_contacts", self.moving_contacts)
        require_flag("free_flight", self.free_flight)

    def refuses(self, dtype: str, solver: ProjectedMethod) -> str:
        """What this engine cannot do; "" as it can do all."""
        return ""

    def solver_in_use(self, solver: ProjectedMethod) -> str:
        """Name of the method that solves contacts; isolated pairs have a closed form."""
        return solver_name(solver)

    def advance(
        self,
        flow: ShearFlow,
        solver: ProjectedMethod,
        state: State,
        steps: Int[Array, "*blocks"],
        observe: Observe | None = None,
    ) -> tuple[State, Tally]:
        """Advance one replica by a number of steps, or by one block of steps after another with a
        tally (blocks,) for each.
        """
        run = partial(
            advance_by_jax,
            observe=observe,
            events=self.events,
            moving_contacts=self.moving_contacts,
            free_flight=self.free_flight,
        )
        # The rules know the arguments only, and reverse mode knows none.
        closes = observe is not None and uses_traced_values(observe, flow, state)
        if self.events is None and not closes:
            run = with_forward_derivative(with_own_batching(run), run)
        return run(flow, solver, state, steps)


@dataclass(frozen=True)
class Numba:
    """The engine compiled by numba: float64 and the solver ``BarzilaiBorwein`` only.

    On a processor it is the automatic choice. It solves clusters one by one, by Gauss–Seidel sweeps
    and then by the method of the solver, to its ``tolerance`` and within its ``max_steps``. Under
    ``jax.vmap`` replicas advance on all cores, with the same bits on any number of threads; the
    environment variable ``NUMBA_NUM_THREADS`` sets their number. ``jax.lax.map`` takes one at a
    time. Derivatives in forward mode, and the values beside them, are those of ``Jax``.

    On a CUDA device a warp advances each replica of a batch, without records for ``observe``, and
    solves all contacts that touch others together. Its code has been run on processors only, by one
    lane and by 32, and no device has run it yet: there it must be asked for.

    Examples:
      >>> Numba()
      Numba()
    """

    name: ClassVar[str] = "numba"

    def refuses(self, dtype: str, solver: ProjectedMethod) -> str:
        """What this engine cannot do of what is asked for, in words; "" if it can do all."""
        wrong = {
            f"on the device {default_device().platform}": not (on_processor() or has_cuda()),
            f"in {dtype} ({ENABLE_X64} computes in float64)": dtype != "float64",
            f"with the solver {solver_name(solver)}": type(solver) is not BarzilaiBorwein,
        }
        return " and ".join(words for words, holds in wrong.items() if holds)

    def solver_in_use(self, solver: ProjectedMethod) -> str:
        """Name of the method that solves contacts; isolated pairs have a closed form."""
        return f"gauss-seidel, {solver_name(solver)} where stiff"

    def advance(
        self,
        flow: ShearFlow,
        solver: ProjectedMethod,
        state: State,
        steps: Int[Array, "*blocks"],
        observe: Observe | None = None,
    ) -> tuple[State, Tally]:
        """As ``Jax.advance``; the list of near pairs outlives a block, where nothing is
        observed.
        """
        if not on_processor() and observe is not None:
            raise InputError(
                "engine numba observes on a processor only: take jg.Jax() on a device."
            )
        run = partial(advance_by_numba, observe=observe)
        differentiable = partial(advance_by_jax, observe=observe)
        return with_forward_derivative(run, differentiable)(flow, solver, state, steps)


Engine = Jax | Numba


def engine_named(name: str) -> Engine | None:
    """The engine by its name on the command line and in files; None for "auto".

    Raises:
      InputError: no engine has this name.

    Examples:
      >>> engine_named("numba"), engine_named("auto")
      (Numba(), None)
    """
    engines: dict[str, Engine | None] = {"auto": None, Jax.name: Jax(), Numba.name: Numba()}
    if str(name) not in engines:
        raise refused("engine", name, f"must be {', '.join(engines)}")
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
        raise refused("engine", engine, "must be jg.Jax(), jg.Numba() or None")
    return Numerics(solver, engine)


def select_engine(numerics: Numerics, state: State | None = None) -> Engine:
    """The engine that was asked for, or ``Numba`` on a processor if it can advance a state, or else
    ``Jax``.

    Args:
      numerics: the solver, and the engine that was asked for.
      state: gives the precision; None for JAX's default precision.

    Raises:
      InputError: the engine that was asked for cannot do this.
    """
    dtype = precision() if state is None else str(state.positions.dtype)
    engine = numerics.engine or (Numba() if on_processor() else Jax())
    wrong = engine.refuses(dtype, numerics.solver)
    if not wrong:
        return engine
    if numerics.engine is not None:
        raise InputError(
            f"engine {engine.name} cannot run {wrong}: take jg.Jax(), or leave the engine out."
        )
    if (
        state is not None
        and precision() == "float32"
        and not engine.refuses("float64", numerics.solver)
    ):
        _warn_once(
            "JAX computes in single precision, in which flows take the engine jax, several times "
            f"slower than the numba engine: begin with {ENABLE_X64}."
        )
    return Jax()


@cache
def _warn_once(message: str) -> None:
    warnings.warn(message, stacklevel=2)
