"""The constitutive law of steady simple shear that the reference map measured, for solvers of
continuum equations.

Nothing is simulated. The averages are those of ``validity``, and so are their errors.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jax.tree_util import register_static

import jaxgran
from jaxgran.files import atomic_write
from jaxgran.io.paths import as_path, require_absent, require_place
from jaxgran.model.checks import as_array, refused, require
from jaxgran.model.display import WithError, text_of
from jaxgran.reference.evaluation import PLANE, Estimate, from_log, module_of, over_range
from jaxgran.reference.table import LENGTH, MEASURED, Table, shipped_table, theory_of, write_columns

_UNITS = MEASURED | {LENGTH: "sigma"}
_POWERS = dict.fromkeys(MEASURED, 2) | {"dissipation_rate": 3, LENGTH: 0}  # of the shear rate
_STEP = 0.01  # between packing fractions of a file
# beginnings of lines of the head of a table that say what else it holds
_INSIDE = ("contents", "theory", "low", "high", "surface")
_MEANING = {  # of the numbers of a file
    "units": "m and sigma are mass and diameter of the mean grain, m = pi/4 sigma^2 times the "
    "density of the grain",
    "shear rate": "1/t; at shear rate s multiply by s^2, the dissipation rate by s^3, and the "
    "length by 1",
    "ci95": "half of the 95 % interval: sampling, interpolation, time step, tolerance and the "
    "difference from a large system, for the length sampling and interpolation; errors of "
    "neighbouring rows are correlated",
    "interpolation": "of logarithms, in sqrt(1 - restitution) and packing_fraction",
}


class Rheology(NamedTuple):
    """Averages of steady simple shear.

    Each has ``value`` and ``ci95``, the half-width of its 95 % interval, both of the shape to which
    the arguments of the law broadcast; () for three numbers.

    ================================  =========  ===================================================
    field                             unit       meaning
    ================================  =========  ===================================================
    pressure                          m/t²       p, half the trace of the stress; proportional to
                                                 γ̇²
    shear_stress                      m/t²       τ, positive; proportional to γ̇²
    granular_temperature              m(σ/t)²    T = Σ m c²/(2N), c the peculiar velocity;
                                                 proportional to γ̇²
    local_granular_temperature        m(σ/t)²    T relative to the flow nearby, which long waves do
                                                 not raise; proportional to γ̇²
    dissipation_rate                  m/t³       Γ, energy lost per area and time, equals τγ̇;
                                                 proportional to γ̇³
    correlation_length_from_pressure  σ          L′ = (Γ_E/p_E)/(Γ/p), p the contact pressure, E
                                                 Enskog's value at the measured local temperature;
                                                 does not depend on γ̇
    ================================  =========  ===================================================
    """

    pressure: Estimate
    shear_stress: Estimate
    granular_temperature: Estimate
    local_granular_temperature: Estimate
    dissipation_rate: Estimate
    correlation_length_from_pressure: Estimate

    def __repr__(self) -> str:
        """The averages, with ± half-widths of 95 % intervals."""
        return text_of("Rheology", {name: WithError(*x) for name, x in self._asdict().items()})


@register_static
@dataclass(frozen=True)
class ConstitutiveLaw:
    """Stresses, temperatures, dissipation and correlation length of a flow as smooth functions; see
    `constitutive_law`.

    A pytree without leaves, which can be passed to transformed functions or closed over.
    """

    table: Table  # averages of a reference map

    def __repr__(self) -> str:
        ranges = ("{}={:.3g} to {:.3g}".format(name, *self.table.range(name)) for name in PLANE)
        return f"ConstitutiveLaw({', '.join(ranges)})"

    @property
    def restitution_range(self) -> tuple[float, float]:
        """Smallest and largest α."""
        return self.table.range("restitution")

    @property
    def packing_fraction_range(self) -> tuple[float, float]:
        """Smallest and largest ν."""
        return self.table.range("packing_fraction")

    def __call__(self, restitution: Any, packing_fraction: Any, shear_rate: Any = 1.0) -> Rheology:
        """Averages of steady simple shear, with their 95 % intervals.

        Args:
          restitution: α, a number or an array.
          packing_fraction: ν, a number or an array.
          shear_rate: γ̇ > 0 in 1/t, a number or an array; the three broadcast.

        Returns:
          A ``Rheology``, in arrays of NumPy where all numbers are known. ``jax.jit``, ``jax.vmap``
          and derivatives apply, in double precision only; NaN where JAX traces a value outside the
          measured range.

        Raises:
          InputError: (a ValueError) a value is outside the measured range, which the message names;
            γ̇ is not positive; or JAX traces a value without ``jax_enable_x64``.
        """
        shear_rate = as_array(shear_rate)
        require("shear_rate", shear_rate, lambda x: (x > 0) & (x < np.inf), "a positive number")
        *_, averages = over_range(self.table, self._at_unit_rate, restitution, packing_fraction)
        xp, shape = module_of(restitution, packing_fraction, shear_rate), np.shape(shear_rate)
        try:
            np.broadcast_shapes(np.shape(averages["pressure"].value), shape)
        except ValueError:
            reason = "must have a shape that broadcasts with those of α and ν"
            raise refused("shear_rate", shape, reason) from None
        scaled = {}
        for name, estimate in averages.items():
            *numbers, rate = xp.broadcast_arrays(*estimate, xp.asarray(shear_rate, float))
            scaled[name] = Estimate(*(x * rate ** _POWERS[name] for x in numbers))
        return Rheology(**scaled)

    def _at_unit_rate(self, where: Any, xp: Any) -> dict[str, Estimate]:
        """Every average at unit shear rate, at coordinates in the range."""
        logs, averages = self.table.series(where, xp), {}
        for name in _UNITS:
            log, half = self.table.log_estimate(name, where, xp)
            log_average = log if name == LENGTH else log + logs[theory_of(name)]
            averages[name] = from_log(log_average, half, xp)
        return averages

    def to_csv(
        self,
        path: str | Path,
        restitution: Any = None,
        packing_fraction: Any = None,
        overwrite: bool = False,
    ) -> None:
        """Write the law as a table, for programs in other languages.

        Lines that begin with ``#`` say what the numbers are: map, N, time step, version, range,
        units and the meaning of the errors. Then come the names of the columns and a row for every
        pair of α and ν.

        Args:
          path: file to write.
          restitution: values of α, (rows,); by default those of the reference map.
          packing_fraction: values of ν, (columns,); by default every 0.01 in the range.
          overwrite: whether a file that is there already is replaced.

        Raises:
          InputError: (a ValueError) a value is outside the measured range, or the file exists or
            cannot be written.
        """
        path = as_path("path", path)
        require_place(path, "path", path.suffix)
        if not overwrite:
            require_absent(path, "law")
        low, high = self.packing_fraction_range
        alphas = (
            np.unique(self.table.columns["restitution"])
            if restitution is None
            else np.ravel(restitution)
        )
        every = np.arange(np.ceil(low / _STEP), high / _STEP + 0.5) * _STEP
        nus = np.round(every, 2) if packing_fraction is None else np.ravel(packing_fraction)
        plane = [x.ravel() for x in np.meshgrid(alphas, nus, indexing="ij")]
        columns: dict[str, Any] = dict(zip(PLANE, plane, strict=True))
        for name, estimate in self(*plane)._asdict().items():
            columns |= {name: estimate.value, f"{name}_ci95": estimate.ci95}
        made_with = {k: v for k, v in self.table.head.items() if not k.startswith(_INSIDE)}
        head = {
            "contents": "steady simple shear of rigid, frictionless discs as measured, "
            "constitutive law of jaxgran",
            "version": jaxgran.__version__,
            **{f"{name} range": "{:g} to {:g}".format(*self.table.range(name)) for name in PLANE},
            **made_with,
            **{f"unit of {name}": unit for name, unit in _UNITS.items()},
            **_MEANING,
        }
        with atomic_write(path) as temporary:
            write_columns(temporary, head, columns)


def constitutive_law() -> ConstitutiveLaw:
    """The constitutive law of the reference map: p, τ, T, Γ and L′ as functions of α and ν with
    their errors.

    Bagnold's scaling holds exactly, as grains are rigid: γ̇ scales stresses and temperatures by
    γ̇², Γ by γ̇³. Averages are surfaces over the series of a theory, so that all derivatives exist.
    Errors of neighbouring points are correlated. At given p and γ̇, or at given τ/p, ν follows by
    Newton's method.

    Examples:
      >>> law = constitutive_law()
      >>> slow, fast = law(0.7, 0.6), law(0.7, 0.6, shear_rate=2.0)
      >>> float(fast.pressure.value / slow.pressure.value)
      4.0
      >>> float(fast.dissipation_rate.value / slow.dissipation_rate.value)
      8.0
    """
    return ConstitutiveLaw(shipped_table())
