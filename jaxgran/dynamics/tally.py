"""Tally: the sums over the steps of one sample, and the one table from which their places in memory
follow.

The fields of ``Tally`` are the table: every row has a shape, a unit, a meaning, and what adds to
it. While the time loop runs, an engine keeps the sums as plain numbers. Their order follows from
the table (``LAYOUT``), so no position is written down anywhere. Where the terms of a sum are
written follows from its kind, see `CONTRIBUTING.md`.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxgran.contact.law import ContactTerms
from jaxgran.model.indexing import taken
from jaxgran.model.state import status_if_finite
from jaxgran.model.values import Value

# What adds to a sum. The running sums of an engine stand in this order, and within it in the order
# of the table.
FLIGHT = "flight"  # the flight between two events
CONTACT = "contact"  # each contact of a solved network, by the law of a contact
SOLVE = "solve"  # each solved network
LARGEST = "largest"  # each solved network; the largest value counts
AT_END = "end"  # the end of an advance
# a reading of the state, which stands for the time since the last one, see ``velocity_scales``
INSTANT = "instant"
KINDS = (FLIGHT, CONTACT, SOLVE, LARGEST, INSTANT)
_TENSOR = (2, 2)  # symmetric; running sums hold xx, xy, yy
Number = Float[Array, "*b"]
Tensor = Float[Array, "*b 2 2"]


def _sum(
    kind: str, unit: str, meaning: str, shape: tuple[int, ...] = (), joined: str = "sum"
) -> Any:
    """A row of the table. Parts are joined by their sum, or by the largest of them."""
    joined = "largest" if kind == LARGEST else joined
    return field(
        metadata={"kind": kind, "unit": unit, "meaning": meaning, "shape": shape, "joined": joined}
    )


@dataclass(frozen=True, eq=False, repr=False)
class Tally(Value):
    """Sums over the steps of a sample of one replica; ``+`` joins two samples.

    Averages, such as the pressure, also need the cell: ``sample`` returns them, with errors.
    """

    duration: Number = _sum(FLIGHT, "1/γ̇", "time")
    steps: Number = _sum(FLIGHT, "–", "time steps, counted as a float (they exceed an int32)")
    impulse: Number = _sum(CONTACT, "mσγ̇", "contact impulses J")
    binary_impulse: Number = _sum(
        CONTACT, "mσγ̇", "(1+α) m_ij max(0, −u⁻), the impulses if every collision were binary"
    )
    contact_moment: Tensor = _sum(
        CONTACT, "mσ²γ̇", "d ⊗ J n over the contacts, d the centre-to-centre vector", _TENSOR
    )
    binary_moment: Tensor = _sum(CONTACT, "mσ²γ̇", "the same with the binary impulses", _TENSOR)
    cluster_moment: Tensor = _sum(
        CONTACT,
        "mσ²γ̇",
        "the contact moment of clusters of three or more grains that push at once",
        _TENSOR,
    )
    kinetic_moment: Tensor = _sum(
        FLIGHT, "mσ²γ̇", "∫ Σ m c ⊗ c dt, exact along the flights", _TENSOR
    )
    dissipation: Number = _sum(CONTACT, "mσ²γ̇²", "energy lost in contacts, −½ Σ J (u⁻ + u⁺)")
    complementarity: Number = _sum(
        CONTACT, "mσ²γ̇²", "½ Σ J (u⁺ + α u⁻), zero where a solve is exact"
    )
    energy_change: Number = _sum(AT_END, "mσ²γ̇²", "growth of the kinetic energy ½ Σ m c²")
    contacts: Number = _sum(CONTACT, "–", "contacts of the steps in which a network was solved")
    loaded_contacts: Number = _sum(CONTACT, "–", "contacts that carry an impulse")
    collisions: Number = _sum(CONTACT, "–", "contacts that approach")
    solves: Number = _sum(SOLVE, "–", "networks solved")
    iterations: Number = _sum(SOLVE, "–", "solver iterations")
    unconverged: Number = _sum(SOLVE, "–", "solves that ended above the tolerance")
    overlap: Number = _sum(CONTACT, "σ", "overlaps of the contacts of solved networks")
    deep_contacts: Number = _sum(
        CONTACT, "–", "contacts that overlap by more than ``DEEP_OVERLAP``"
    )
    binary_speed_moment: Tensor = _sum(
        CONTACT,
        "mσ³γ̇²",
        "the binary moment, each contact times its speed of approach max(0, −u⁻)",
        _TENSOR,
    )
    binary_dissipation: Number = _sum(
        CONTACT,
        "mσ²γ̇²",
        "½ (1−α²) m_ij max(0, −u⁻)², the energy lost if every collision were binary",
    )
    largest_overlap: Number = _sum(LARGEST, "σ", "overlap of a contact")
    worst_residual: Number = _sum(LARGEST, "–", "relative residual of a solve")
    local_kinetic: Number = _sum(
        INSTANT,
        "mσ²γ̇",
        "granular temperature relative to the mean velocity of a box, times the time between "
        "readings",
    )
    wave_kinetic: Number = _sum(
        INSTANT,
        "mσ²γ̇",
        "granular temperature of the longest waves, times the time between readings",
    )
    momentum_drift: Number = _sum(AT_END, "–", "|Σ m c| over Σ m |c|, at the end", joined="largest")
    status: Int[Array, "*b"] = _sum(AT_END, "–", "status, the worst", joined="largest")
    observed: Any = None  # sums of what a user's function observes, a pytree; None without one

    def __add__(self, other: "Tally") -> "Tally":
        return jax.tree.map(lambda *both: jnp.stack(both), self, other).total(axis=0)

    def total(self, axis: int | tuple[int, ...]) -> "Tally":
        """The tally over these axes: sums, and the largest of each of ``EXTREMES``."""
        sums = {name: getattr(self, name) for name in TABLE}
        joined = {
            name: x.max(axis) if name in EXTREMES else x.sum(axis) for name, x in sums.items()
        }
        return Tally(**joined, observed=jax.tree.map(lambda x: x.sum(axis), self.observed))


TABLE = {row.name: row.metadata for row in fields(Tally) if row.metadata}
EXTREMES = tuple(
    name for name, row in TABLE.items() if row["joined"] == "largest"
)  # joined by the larger one


def _layout() -> dict[str, slice]:
    """Where each of the running sums stands, for an engine that keeps them in one row of
    numbers.
    """
    places, begin = {}, 0
    for kind in KINDS:
        for name, row in TABLE.items():
            if row["kind"] == kind:
                size = 3 if row["shape"] == _TENSOR else int(np.prod(row["shape"], dtype=int))
                places[name] = slice(begin, begin + size)
                begin += size
    places["read_until"] = slice(begin, begin + 1)  # the time of the last reading; no sum
    return places


LAYOUT = _layout()
NUMBERS = max(place.stop for place in LAYOUT.values())  # of the running sums


def place_of(name: str) -> int:
    """Where a running sum begins."""
    return LAYOUT[name].start


def span_of(kind: str) -> slice:
    """Where the running sums of one kind stand."""
    places = [LAYOUT[name] for name, row in TABLE.items() if row["kind"] == kind]
    return slice(places[0].start, places[-1].stop)


def _columns(kind: str) -> tuple[str, ...]:
    """The names of the running sums of one kind, in their order."""
    rows = [(name, row["shape"]) for name, row in TABLE.items() if row["kind"] == kind]
    ends = {_TENSOR: ("_xx", "_xy", "_yy"), (): ("",)}
    return tuple(name + end for name, shape in rows for end in ends[shape])


if ContactTerms._fields != _columns(CONTACT):
    raise TypeError(
        "ContactTerms must have the fields of the rows of Tally for contacts, in their order: "
        f"{', '.join(_columns(CONTACT))}."
    )


class RunningSums(NamedTuple):
    """What the time loop of an engine carries, until ``tally`` gives the sums their names.

    =========  ==========  =========================================================================
    field      shape       meaning
    =========  ==========  =========================================================================
    numbers    (numbers,)  the sums in the order of ``LAYOUT``, and the time of the last reading
    status     ()          the worst status
    user_sums  pytree      sums of what a user's function observes, see ``observer``; () without one
    =========  ==========  =========================================================================
    """

    numbers: Float[Array, " numbers"]
    status: Int[Array, ""]
    user_sums: Any = ()

    def of(self, kind: str) -> Float[Array, " kind"]:
        """The sums of one kind."""
        return self.numbers[span_of(kind)]

    def added(self, contact_sums: Array | None = None, **terms: Any) -> "RunningSums":
        """The sums with terms added by name; of ``LARGEST`` the larger value is kept.

        Args:
          contact_sums: the terms of all sums of the kind ``CONTACT``, in their order.
          terms: those of all sums of their kind; of a tensor xx, xy and yy.
        """
        kinds = {TABLE[name]["kind"] for name in terms}
        changed = {} if contact_sums is None else {CONTACT: self.of(CONTACT) + contact_sums}
        for kind in (FLIGHT, SOLVE, LARGEST):
            if kind in kinds:
                values = [terms[name] for name, row in TABLE.items() if row["kind"] == kind]
                parts = jax.tree.leaves(values)
                row = jnp.stack([jnp.asarray(x).astype(self.numbers.dtype) for x in parts])
                sums = self.of(kind)
                changed[kind] = jnp.maximum(sums, row) if kind == LARGEST else sums + row
        return self._replaced(changed)

    def _replaced(self, kinds: dict[str, Float[Array, " kind"]]) -> "RunningSums":
        numbers = self.numbers
        for kind, values in kinds.items():
            numbers = lax.dynamic_update_slice(numbers, values, (span_of(kind).start,))
        return self._replace(numbers=numbers)

    def value(self, name: str) -> Array:
        """The sum of this name."""
        numbers = self.numbers[LAYOUT[name]]
        if TABLE.get(name, {}).get("shape") == _TENSOR:
            return taken(numbers, jnp.asarray([0, 1, 1, 2])).reshape(2, 2)
        return numbers[0]

    def with_reading(self, readings: Float[Array, " instant"]) -> "RunningSums":
        """The sums with readings of the state now, which stand for the time since the last ones."""
        duration = self.value("duration")
        since = duration - self.value("read_until")
        read = self._replaced({INSTANT: self.of(INSTANT) + since * readings})
        return read._replace(numbers=read.numbers.at[place_of("read_until")].set(duration))

    def tally(self, **ends: Array) -> Tally:
        """The tally; ``nonfinite`` if a sum is not finite.

        Args:
          ends: the sums that are known only at the end of an advance, by name, without the status.
        """
        finite = status_if_finite(self.numbers, *ends.values())
        ends = {**ends, "status": jnp.maximum(self.status, finite)}
        return Tally(**{name: ends[name] if name in ends else self.value(name) for name in TABLE})


def empty_sums(dtype: jnp.dtype) -> RunningSums:
    """The running sums of no time at all."""
    return RunningSums(jnp.zeros(NUMBERS, dtype), jnp.int32(0))


def empty_tally(dtype: jnp.dtype) -> Tally:
    """The tally of no time at all."""
    zero = jnp.zeros((), dtype)
    return empty_sums(dtype).tally(
        **{name: zero for name, row in TABLE.items() if row["kind"] not in KINDS}
    )


def flat_tally(tally: Tally, shape: tuple[int, ...]) -> np.ndarray:
    """All numbers of a tally with leading axes of the given shape, (*shape, numbers) in double
    precision.
    """
    leaves = [np.asarray(leaf, np.float64).reshape(*shape, -1) for leaf in jax.tree.leaves(tally)]
    return np.concatenate(leaves, axis=-1)


def tally_from_flat(numbers: np.ndarray, dtype: jnp.dtype, observed: Any = None) -> Tally:
    """The tally whose numbers ``flat_tally`` has put together, bit for bit.

    Args:
      numbers: (..., numbers); any behind those of the tally are left out.
      dtype: of the sums.
      observed: a pytree with the shapes of the user's sums.
    """
    leaves, structure = jax.tree.flatten(replace(empty_tally(dtype), observed=observed))
    edges = np.cumsum([leaf.size for leaf in leaves])
    parts = zip(np.split(numbers, edges, axis=-1)[:-1], leaves, strict=True)
    shape = numbers.shape[:-1]
    return jax.tree.unflatten(
        structure, [x.reshape(*shape, *leaf.shape).astype(leaf.dtype) for x, leaf in parts]
    )


def _documentation() -> str:
    """The table as the docstring of ``Tally`` shows it."""
    rows = [("field", "shape", "unit", "sum of")]
    for name, row in TABLE.items():
        largest = "(the largest) " if row["joined"] == "largest" else ""
        rows.append((name, str(row["shape"]), row["unit"], largest + row["meaning"]))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    border = "  ".join("=" * width for width in widths)
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return "\n".join(["", "", border, lines[0], border, *lines[1:], border])


Tally.__doc__ = (Tally.__doc__ or "") + _documentation()
