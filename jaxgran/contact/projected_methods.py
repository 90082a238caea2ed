"""The projected methods: how one iterate of a contact solve follows from those before it.

All of them take projected steps J ← max(0, y − t D⁻¹(W y + u⁻)) from a point y, with D the
``spectral_bound`` of ``delassus``, and cost one product with W each. They differ in y and in the
step length t:

=================  ==============================  =================================================
method             point y                         step length t
=================  ==============================  =================================================
Jacobi             J                               relaxation ω
Nesterov           J + k/(k+3) (J − J_before)      1; k restarts when the step turns uphill
BarzilaiBorwein    J                               curvature along the last step; guarded
=================  ==============================  =================================================

Where W ⪯ D, a Jacobi step lowers ½JᵀWJ + (u⁻)ᵀJ for every ω < 2, and Nesterov's method converges at
t = 1. With diag(W) neither holds (``benchmarks/stability.py``).

Barzilai and Borwein take t from the last step s: sᵀDs/sᵀWs and sᵀWs/(Ws)ᵀD⁻¹(Ws) in turn, both at
least 1 as W ⪯ D. The objective does not fall in every step, and with a projection the iterates can
cycle. The safeguard needs no values of the objective: where the best residual has not halved over
100 steps, the method continues as Nesterov's. So either the residual falls at that rate, or the
iteration is one that converges. This is the default: in dense flows it needs a tenth to a third
fewer products than Nesterov's method alone (``benchmarks solvers``).

A subclass of ``ProjectedMethod`` is a method too, wherever it is written.

Sources: Nesterov (1983); O'Donoghue and Candès (2015) for the restart; Barzilai and Borwein (1988);
Birgin, Martínez and Raydan (2000) for projected spectral gradients.
"""

import json
from dataclasses import dataclass, fields
from inspect import isfunction
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.delassus import DelassusOperator
from jaxgran.contact.law import LONGEST_STRIDE, PROGRESS, WINDOW
from jaxgran.model.checks import InputError, concrete_or_none, refused, require_number
from jaxgran.model.choices import SolverName
from jaxgran.model.values import register_fields

IMPULSES, RESPONSE = range(2)  # rows of a point: J and W J


class Iterate(NamedTuple):
    """State of the iteration."""

    point: Float[Array, "2 contacts"]
    previous: Float[Array, "2 contacts"]
    memory: Any
    best_residual: Float[Array, ""]
    iterations: Int[Array, ""]


@dataclass(frozen=True)
class ProjectedMethod:
    """Base class of the methods that solve the contacts of a step: 0 ≤ J ⟂ W J + u⁻ ≥ 0.

    ==========  =====  ====  =======================================================================
    field       shape  unit  meaning
    ==========  =====  ====  =======================================================================
    tolerance   ()     –     relative residual ‖min(diag(W) J, W J + u⁻)‖ / ‖min(u⁻, 0)‖ to reach,
                             1e-12 to 0.1; ``law.residual_target`` adds what is lost in rounding
    max_steps   ()     –     largest number of iterations; the best iterate is then returned, with a
                             status
    ==========  =====  ====  =======================================================================

    Each iteration is a projected step J ← max(0, y − t D⁻¹(W y + u⁻)). A subclass says what D, y
    and t are, by overriding one or more of ``bound``, ``init``, ``propose`` and ``learn``. What is
    inherited is Jacobi's method with D the spectral bound and t = 1. A subclass is a frozen
    dataclass. It is a JAX pytree whose fields are traced: other numbers recompile nothing. A field
    with ``metadata={"static": True}`` is static.

    Raises:
      InputError: (a ValueError) a number is outside its range, where traced numbers are not
        checked; or a subclass has another public method, which would never be called.

    Examples:
      Momentum of a constant share β, y = J + β (J − J_before), with t = 1:

      >>> @dataclass(frozen=True)
      ... class ConstantMomentum(ProjectedMethod):
      ...     momentum: float = 0.5
      ...
      ...     def propose(self, now):
      ...         return now.point + self.momentum * (now.point - now.previous), 1.0
      >>> ConstantMomentum(tolerance=1e-6)
      ConstantMomentum(tolerance=1e-06, max_steps=5000, momentum=0.5)
    """

    tolerance: float | Float[Array, ""] = 1e-4
    max_steps: int | Int[Array, ""] = 5000

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        hooks = {name for name in vars(ProjectedMethod) if not name.startswith("_")}
        for name, value in vars(cls).items():
            if isfunction(value) and not name.startswith("_") and name not in hooks:
                raise InputError(
                    f"a ProjectedMethod overrides bound, init, propose or learn, and {name} of "
                    f"{cls.__name__} would never be called; name a function of your own _{name}."
                )
        register_fields(cls)

    def __post_init__(self) -> None:
        words = "between 1e-12 and 0.1"
        require_number("tolerance", self.tolerance, lambda x: (x >= 1e-12) & (x <= 0.1), words)

        def is_whole(x: np.ndarray) -> Any:
            return (x >= 1) & (x <= 2**31 - 1) & (x == np.floor(x))

        require_number("max_steps", self.max_steps, is_whole, "a whole number of at least 1")

    def bound(self, operator: DelassusOperator) -> Float[Array, " contacts"]:
        """Diagonal D of positive numbers in place of W, see ``delassus``."""
        return operator.spectral_bound()

    def init(self, approach: Float[Array, " contacts"]) -> Any:
        """What the method remembers between iterations, at the start: a pytree of floats;
        ``approach`` is u⁻.
        """
        return ()

    def propose(self, now: Iterate) -> tuple[Float[Array, "2 contacts"], float | Float[Array, ""]]:
        """Point y, as impulses and their response W y, and step length t."""
        return now.point, 1.0

    def learn(
        self,
        now: Iterate,
        start: Float[Array, "2 contacts"],
        point: Float[Array, "2 contacts"],
        bound: Float[Array, " contacts"],
        best_residual: Float[Array, ""],
    ) -> Any:
        """What is remembered after the step from y to J, in the form of ``init``.

        Args:
          now: the state before the step.
          start, point: y and J, each with its response.
          bound: the diagonal D.
          best_residual: ‖min(diag(W) J, W J + u⁻)‖, the smallest so far, in σγ̇.
        """
        return now.memory


register_fields(ProjectedMethod)


class _GuardedSteps(NamedTuple):
    """What ``BarzilaiBorwein`` remembers.

    stride: step length t.
    guarded: 1 where Nesterov's method has taken over, otherwise 0.
    k: steps of Nesterov's method since its last restart.
    last_residual: the best residual at the end of the last window.
    """

    stride: Any
    guarded: Any
    k: Any
    last_residual: Any


@dataclass(frozen=True)
class BarzilaiBorwein(ProjectedMethod):
    """The method of Barzilai and Borwein with a safeguard, the default; fields as
    ``ProjectedMethod``.

    Source: J. Barzilai and J. M. Borwein, IMA J. Numer. Anal. 8, 141 (1988); projected by E. G.
    Birgin, J. M. Martínez and M. Raydan, SIAM J. Optim. 10, 1196 (2000).

    Examples:
      >>> BarzilaiBorwein(tolerance=1e-6)
      BarzilaiBorwein(tolerance=1e-06, max_steps=5000)
    """

    def init(self, approach: Array) -> _GuardedSteps:
        return _GuardedSteps(stride=1.0, guarded=0.0, k=0.0, last_residual=float("inf"))

    def propose(self, now: Iterate) -> tuple[Array, Array]:
        k = now.memory.k
        return now.point + k / (k + 3) * (now.point - now.previous), now.memory.stride

    def learn(
        self, now: Iterate, start: Array, point: Array, bound: Array, best_residual: Array
    ) -> _GuardedSteps:
        _, was_guarded, k, last_residual = now.memory
        window_ends = now.iterations % WINDOW == WINDOW - 1
        stalled = window_ends & ~(best_residual < PROGRESS * last_residual)
        guarded = (was_guarded > 0) | stalled
        step, response = point - now.point
        is_long = now.iterations % 2 == 1  # long and short steps in turn
        along_step = is_long | guarded
        # One product for all cases: sᵀDs of a long step, (Ws)ᵀD⁻¹Ws of a short one, and the descent
        # of a guarded one, which is positive where the step turns uphill
        scaled_step = bound * jnp.where(guarded, start[IMPULSES] - point[IMPULSES], step)
        scaled = jnp.where(along_step, scaled_step, response / bound)
        square = dot(scaled, jnp.where(along_step, step, response))
        curvature = dot(step, response)  # sᵀWs
        numerator = jnp.where(is_long, square, curvature)
        denominator = jnp.where(is_long, curvature, square)
        curved = denominator > 0
        quotient = numerator / jnp.where(curved, denominator, 1)
        stride = jnp.where(curved, jnp.minimum(quotient, LONGEST_STRIDE), LONGEST_STRIDE)
        accelerates = (was_guarded > 0) & ~(square > 0)
        return _GuardedSteps(
            stride=jnp.where(guarded, 1, stride),
            guarded=guarded,
            k=jnp.where(accelerates, k + 1, 0),
            last_residual=jnp.where(window_ends, best_residual, last_residual),
        )


@dataclass(frozen=True)
class Nesterov(ProjectedMethod):
    """Nesterov's accelerated method with restarts; fields as ``ProjectedMethod``.

    Source: Y. Nesterov, Sov. Math. Dokl. 27, 372 (1983); the restart: B. O'Donoghue and E. Candès,
    Found. Comput. Math. 15, 715 (2015).

    Examples:
      >>> Nesterov()
      Nesterov(tolerance=0.0001, max_steps=5000)
    """

    def init(self, approach: Array) -> Any:
        return 0.0  # the momentum k

    def propose(self, now: Iterate) -> tuple[Array, Array]:
        k = now.memory
        return now.point + k / (k + 3) * (now.point - now.previous), jnp.ones_like(k)

    def learn(
        self, now: Iterate, start: Array, point: Array, bound: Array, best_residual: Array
    ) -> Any:
        step = point[IMPULSES] - now.point[IMPULSES]
        uphill = dot(bound * (start[IMPULSES] - point[IMPULSES]), step) > 0
        return jnp.where(uphill, 0, now.memory + 1)


@dataclass(frozen=True)
class Jacobi(ProjectedMethod):
    """Projected Jacobi with the spectral bound, of relaxation ω; other fields as
    ``ProjectedMethod``.

    ==========  =====  ====  =============
    field       shape  unit  meaning
    ==========  =====  ====  =============
    relaxation  ()     –     ω in (0, 2)
    ==========  =====  ====  =============

    Source: O. L. Mangasarian, J. Optim. Theory Appl. 22, 465 (1977).

    Raises:
      InputError: (a ValueError) as ``ProjectedMethod``.

    Examples:
      >>> Jacobi(relaxation=1.5)
      Jacobi(tolerance=0.0001, max_steps=5000, relaxation=1.5)
    """

    relaxation: float | Float[Array, ""] = 1.8

    def __post_init__(self) -> None:
        super().__post_init__()
        words = "between 0 and 2, both excluded"
        require_number("relaxation", self.relaxation, lambda x: (x > 0) & (x < 2), words)

    def propose(self, now: Iterate) -> tuple[Array, Array]:
        return now.point, jnp.asarray(self.relaxation, now.point.dtype)


DEFAULT_SOLVER = BarzilaiBorwein()
# By their names on the command line and in files
SOLVERS: dict[SolverName, type[ProjectedMethod]] = {
    "barzilai-borwein": BarzilaiBorwein,
    "nesterov": Nesterov,
    "jacobi": Jacobi,
}


def solver_name(solver: ProjectedMethod) -> str:
    """The name of a method in files and messages; that of a user's own class says where it is
    defined.

    Examples:
      >>> solver_name(Nesterov())
      'nesterov'
    """
    kind = type(solver)
    names = {cls: name for name, cls in SOLVERS.items()}
    return names.get(kind, f"{kind.__module__}.{kind.__qualname__}")


def solver_numbers(solver: ProjectedMethod) -> dict[str, Any]:
    """The fields of a method in types of JSON; those that are no numbers as text.

    Examples:
      >>> solver_numbers(Nesterov(tolerance=1e-6))
      {'tolerance': 1e-06, 'max_steps': 5000}
    """
    values = {field.name: getattr(solver, field.name) for field in fields(solver)}
    return {name: _in_json(value) for name, value in values.items()}


def solver_text(solver: ProjectedMethod) -> str:
    """Name and fields of a method, by which that of a user's class is compared.

    Examples:
      >>> solver_text(Nesterov(tolerance=1e-6))
      'nesterov {"tolerance": 1e-06, "max_steps": 5000}'
    """
    return f"{solver_name(solver)} {json.dumps(solver_numbers(solver))}"


def _in_json(value: Any) -> Any:
    number = concrete_or_none(value)
    return repr(value) if number is None or number.dtype.kind not in "biuf" else number.tolist()


def require_solver(solver: Any) -> None:
    """Raise an InputError unless this is a projected method."""
    if not isinstance(solver, ProjectedMethod):
        words = "must be a ProjectedMethod, such as jg.BarzilaiBorwein()"
        raise refused("solver", solver, words)


def dot(a: Float[Array, " contacts"], b: Float[Array, " contacts"]) -> Float[Array, ""]:
    """Scalar product in full precision on every backend."""
    return jnp.dot(a, b, precision=lax.Precision.HIGHEST)
