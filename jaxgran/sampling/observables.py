"""Observables: the averages of a sample, one row each.

Nothing here needs JAX, so that files are read without loading it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Array

    from jaxgran.sampling.averages import Sums

STRESS_UNIT = (
    "m / t^2"  # in two dimensions; t is the time unit of the shear rate, 1/shear rate by default
)
TENSOR_AXES = ("axis_a", "axis_b")  # of the centre-to-centre vector, of the force


@dataclass(eq=False)
class Observable:
    """An observable, and the attribute of a sample that is its average.

    Args:
      meaning: what it is, without its unit.
      formula: its value from the ``Sums`` of a sample, which have the other observables by name.
      unit: "1" for a pure number.
      group: of the file of a map, "/" for its root; the tables of ``jaxgran run`` have the same
        groups.
      tensor: whether it has the two dimensions ``TENSOR_AXES`` of two components.
      extreme: whether it is the largest of all time steps, so that its error is the spread over
        blocks.
    """

    meaning: str
    formula: "Callable[[Sums], Any]"
    unit: str = "1"
    group: str = "/"
    tensor: bool = False
    extreme: bool = False

    def __set_name__(self, owner: type, name: str) -> None:
        self.name, self.__doc__ = name, f"{self.meaning}, unit {self.unit}"

    @overload
    def __get__(self, sample: None, owner: type) -> "Observable": ...

    @overload
    def __get__(self, sample: "Observables", owner: type) -> "Array | np.ndarray": ...

    def __get__(self, sample: Any, owner: type) -> Any:
        return self if sample is None else sample.averages[self.name]

    @property
    def axes(self) -> tuple[str, ...]:
        """The names of the dimensions of a tensor; none for a scalar."""
        return TENSOR_AXES if self.tensor else ()


class Observables:
    """Every observable as an attribute, from the mapping ``averages``: this is the table of all
    observables, and a row is all that one needs.
    """

    force_ratio = Observable(
        "mean contact force over mean binary contact force",
        lambda s: s.ratio(s.tally.impulse, s.tally.binary_impulse),
    )
    stress_ratio = Observable(
        "contact stress over binary stress, by component",
        lambda s: s.ratio(s.contact_stress, s.binary_stress),
        tensor=True,
    )
    pressure = Observable(
        "pressure, contact and kinetic",
        lambda s: s.contact_pressure + s.kinetic_pressure,
        STRESS_UNIT,
    )
    shear_stress = Observable(
        "shear stress, contact and kinetic, positive",
        lambda s: -s.contact_stress[..., 0, 1] - s.kinetic_stress[..., 0, 1],
        STRESS_UNIT,
    )
    macroscopic_friction = Observable(
        "shear stress over pressure", lambda s: s.shear_stress / s.pressure
    )
    inertial_number = Observable(
        "shear rate times the square root of the mass of a mean grain over the pressure",
        lambda s: s.shear_rate / s.xp.sqrt(s.pressure),
    )
    granular_temperature = Observable(
        "granular temperature, sum of m c^2 over 2 N",
        lambda s: s.kinetic_pressure * s.area / s.grains,
        "m sigma^2 / t^2",
    )
    local_granular_temperature = Observable(
        "granular temperature relative to the mean velocity of boxes of about 25 grains",
        lambda s: s.ratio(s.tally.local_kinetic, s.tally.duration),
        "m sigma^2 / t^2",
    )
    coordination_number = Observable(
        "contacts per grain that carry an impulse (twice their number over the grains)",
        lambda s: 2 * s.tally.loaded_contacts / (s.grains * s.tally.steps),
    )
    collision_rate = Observable(
        "approaching contacts per grain and unit strain, each grain counting its own",
        lambda s: 2 * s.tally.collisions / (s.grains * s.tally.duration * s.shear_rate),
    )

    contact_stress = Observable(
        "stress of the contact forces",
        lambda s: s.tally.contact_moment / s.volume[..., None, None],
        STRESS_UNIT,
        "stresses",
        tensor=True,
    )
    binary_stress = Observable(
        "stress of the contact forces if collisions were binary",
        lambda s: s.tally.binary_moment / s.volume[..., None, None],
        STRESS_UNIT,
        "stresses",
        tensor=True,
    )
    kinetic_stress = Observable(
        "stress of the peculiar motion",
        lambda s: s.tally.kinetic_moment / s.volume[..., None, None],
        STRESS_UNIT,
        "stresses",
        tensor=True,
    )
    dissipation_rate = Observable(
        "energy that contacts lose per unit area and time",
        lambda s: s.tally.dissipation / s.volume,
        "m / t^3",
        "stresses",
    )
    binary_dissipation_rate = Observable(
        "energy that contacts would lose if collisions were binary",
        lambda s: s.tally.binary_dissipation / s.volume,
        "m / t^3",
        "stresses",
    )
    cluster_pressure_share = Observable(
        "share of the contact pressure in clusters of three or more grains",
        lambda s: s.ratio(s.trace(s.tally.cluster_moment), s.trace(s.tally.contact_moment)),
        group="stresses",
    )
    cluster_shear_share = Observable(
        "share of the contact shear stress in clusters of three or more grains",
        lambda s: s.ratio(s.tally.cluster_moment[..., 0, 1], s.tally.contact_moment[..., 0, 1]),
        group="stresses",
    )

    iterations = Observable(
        "solver iterations per solved network",
        lambda s: s.ratio(s.tally.iterations, s.tally.solves),
        group="diagnostics",
    )
    worst_residual = Observable(
        "largest relative residual of a solved network",
        lambda s: s.tally.worst_residual,
        group="diagnostics",
        extreme=True,
    )
    unconverged_share = Observable(
        "share of the solved networks that ended above the tolerance",
        lambda s: s.ratio(s.tally.unconverged, s.tally.solves),
        group="diagnostics",
    )
    mean_overlap = Observable(
        "mean overlap of the contacts of a solved network",
        lambda s: s.ratio(s.tally.overlap, s.tally.contacts),
        "sigma",
        "diagnostics",
    )
    max_overlap = Observable(
        "largest overlap of a contact",
        lambda s: s.tally.largest_overlap,
        "sigma",
        "diagnostics",
        extreme=True,
    )
    momentum_drift = Observable(
        "largest total momentum over the sum of the momenta of the grains",
        lambda s: s.tally.momentum_drift,
        group="diagnostics",
        extreme=True,
    )
    energy_balance_error = Observable(
        "shear work less dissipation and growth of the kinetic energy, over shear work",
        lambda s: s.ratio(s.work - s.tally.dissipation - s.tally.energy_change, s.xp.abs(s.work)),
        group="diagnostics",
    )
    complementarity_power = Observable(
        "sum of J (u+ + alpha u-)/2, which an exact solve makes zero, over shear work",
        lambda s: s.ratio(s.tally.complementarity, s.xp.abs(s.work)),
        group="diagnostics",
    )
    longwave_energy_ratio = Observable(
        "kinetic energy of the four longest waves of velocity over that of equipartition",
        lambda s: s.ratio(s.tally.wave_kinetic, s.granular_temperature * s.tally.duration),
        group="diagnostics",
    )


OBSERVABLES = {name: row for name, row in vars(Observables).items() if isinstance(row, Observable)}
GROUPS = {
    group: tuple(name for name, row in OBSERVABLES.items() if row.group == group)
    for group in dict.fromkeys(row.group for row in OBSERVABLES.values())
}
"""Names of the observables by their group in the file of a map."""


def unit_attributes(unit: str) -> dict[str, str]:
    """The attributes of a dataset's variable that give its unit: all are numbers in units of m, σ
    and t.
    """
    return {"units": "1"} if unit == "1" else {"reduced_unit": unit, "units": "1"}


def unit_text(unit: str) -> str:
    """A unit of the tables with its signs, such as ``mσ²/t²`` for ``m sigma^2 / t^2``; nothing for
    a pure number.
    """
    for word, sign in (
        ("shear rate", "γ̇"),
        ("m sigma", "mσ"),
        ("sigma", "σ"),
        ("^2", "²"),
        ("^3", "³"),
        (" / ", "/"),
    ):
        unit = unit.replace(word, sign)
    return "" if unit == "1" else unit
