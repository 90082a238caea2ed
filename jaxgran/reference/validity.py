"""Where kinetic theory can predict the stress of a granular flow: the answer for any restitution
and packing fraction.

Nothing is simulated. Averages are read from the surfaces of a reference map that is shipped with
the package (module ``table``), the prediction of the theory from a series. Both are smooth, so that
derivatives exist.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.model.display import WithError, text_of, to_two_digits, with_error
from jaxgran.reference.evaluation import estimates, over_range
from jaxgran.reference.table import (
    CORRECTED,
    FACTORS,
    Table,
    excess_from_surface,
    shipped_table,
    theory_of,
)

COLUMNS = ("average", "measured", "theory", "error", "error if corrected")
"""What ``Validity.rows`` gives of every average."""

ASSUMPTIONS = {
    "local_temperature": "the granular temperature equals the local one",
    "anisotropy": "velocities are isotropic",
    "chaos": "velocities of colliding grains are independent",
    "pairs": "as many pairs are at contact as in equilibrium",
    "binary": "collisions are binary",
}
"""What the theory assumes, by the name of its factor."""

_NEGLIGIBLE = 0.02  # a factor of the contact pressure this close to one is not said to fail


class Validity(NamedTuple):
    """What was measured at a restitution and a packing fraction, and what kinetic theory says.

    All arrays have the shape to which restitution and packing fraction broadcast; () for two
    numbers. ``NAME_ci95`` is the half-width of a 95 % interval.

    =============  =================================================================================
    field          content
    =============  =================================================================================
    measured       average by name: pressure and shear_stress in m/t², granular_temperature and
                   local_granular_temperature in m(σ/t)², dissipation_rate in m/t³, force_ratio
    measured_ci95  of each: sampling, interpolation, time step, tolerance, and the difference from a
                   large system
    theory         pressure, shear_stress, granular_temperature and dissipation_rate of kinetic
                   theory, same units
    error          theory over measured, less one, of all but the granular temperature and the force
                   ratio; the theory's temperature is compared with the local one
    error_ci95     of each
    corrected      the same predictions by ``corrected_shear``, with measured laws of correlations
                   and pairs
    corrected_error, corrected_error_ci95 as error and error_ci95
    factors        the assumptions of Enskog's contact pressure at the measured granular
                   temperature, by name: factors whose product is the measured contact pressure over
                   Enskog's (``sampling.enskog_factors``)
    factors_ci95   of each, from sampling and interpolation at the number of grains of the map
    =============  =================================================================================
    """

    restitution: Any
    packing_fraction: Any
    measured: dict[str, Any]
    measured_ci95: dict[str, Any]
    theory: dict[str, Any]
    error: dict[str, Any]
    error_ci95: dict[str, Any]
    corrected: dict[str, Any]
    corrected_error: dict[str, Any]
    corrected_error_ci95: dict[str, Any]
    factors: dict[str, Any]
    factors_ci95: dict[str, Any]

    def __repr__(self) -> str:
        """Where it is, and the measured averages with ± half-widths of 95 % intervals."""
        where = {"restitution": self.restitution, "packing_fraction": self.packing_fraction}
        measured = {
            name: WithError(x, self.measured_ci95[name]) for name, x in self.measured.items()
        }
        return text_of("Validity", where | measured)

    def fails_first(self) -> Any:
        """The name of the factor that is furthest from one, in logarithm; "none" where all are
        within 2 % of one.

        For values that are known, not traced by JAX: a string, or an array of strings.
        """
        logs = np.abs(np.log([self.factors[name] for name in FACTORS]))
        names = np.array(FACTORS, object)[np.argmax(logs, axis=0)]
        failing = np.where(np.max(logs, axis=0) > _NEGLIGIBLE, names, "none")
        return failing if failing.ndim else str(failing)

    def over_enskog(self) -> Any:
        """The measured contact pressure over Enskog's at the measured granular temperature."""
        return math.prod(self.factors[name] for name in FACTORS)

    def at(self, place: Any) -> "Validity":
        """One flow of an array of flows, or a part of them; for values that are known, not
        traced.
        """

        def part(x: Any) -> Any:
            return (
                {name: part(value) for name, value in x.items()}
                if isinstance(x, dict)
                else np.asarray(x)[place]
            )

        return Validity(*map(part, self))

    def verdict(self) -> Any:
        """The answer in words for every flow: a string, or an array of strings. Values must not
        be traced.
        """
        verdicts = np.empty(np.shape(self.error["pressure"]), object)
        for place in np.ndindex(verdicts.shape):
            verdicts[place] = self.at(place)._verdict()
        return verdicts if verdicts.ndim else verdicts.item()

    def rows(self) -> list[list[str]]:
        """The ``COLUMNS`` of every average of one flow, as texts; an average and an error with a 95
        % interval.
        """
        rows = []
        for name, measured in self.measured.items():
            predicted = self.theory.get(name.removeprefix("local_"))
            theory, errors = "", ["", ""]
            if name in self.error:
                theory = f"{predicted:.4g}"
                of_theories = (
                    (self.error[name], self.error_ci95[name]),
                    (self.corrected_error[name], self.corrected_error_ci95[name]),
                )
                errors = [
                    f"{with_error(100 * float(x), 100 * float(ci95))} %" for x, ci95 in of_theories
                ]
            interval = with_error(float(measured), float(self.measured_ci95[name]))
            rows.append([name.replace("_", " "), interval, theory, *errors])
        return rows

    def _verdict(self) -> str:
        """The verdict on one flow."""
        pressure, of_temperature = map(self._departure, ("pressure", "local_granular_temperature"))
        same = pressure[0] == of_temperature[0]
        start = (
            f"Kinetic theory {pressure[0]} the pressure{pressure[1]} and "
            f"{'' if same else of_temperature[0] + ' '}the local temperature{of_temperature[1]}"
        )
        first = self.fails_first()
        enskog = "Enskog's contact pressure"
        if first == "none":
            cause = f"Each of its assumptions holds within 2 %; all together make {enskog}"
        else:
            cause = (
                f"The assumption that is violated most is that {ASSUMPTIONS[first]}: alone it "
                f"makes {enskog} {_deviation(self.factors[first])}; all together make it"
            )
        ratio, ratio_ci95 = (float(x["force_ratio"]) for x in (self.measured, self.measured_ci95))
        off = max(ratio - 1, 0.0) + ratio_ci95
        step = f"dt = {shipped_table().timestep}/γ̇"
        if off < 0.05:
            most = 1 + float(f"{off:.1g}")
            binary = f"Collisions are binary (force ratio at most {most:g}, {step})"
        else:
            explained = f"{100 / ratio:.2g} % of the mean contact force"
            binary = f"Binary collisions explain {explained} ({step})"
        joint = f"{_deviation(self.over_enskog())} at the measured temperature"
        return f"{start}. {cause} {joint}; the rest is the error of the temperature. {binary}."

    def _departure(self, name: str) -> tuple[str, str]:
        """What the theory does with an average: a verb, and by how much."""
        error, ci95 = (100 * float(x[name]) for x in (self.error, self.error_ci95))
        if abs(error) <= ci95:
            return "agrees with", f" (error {with_error(error, ci95)} %)"
        side = "over" if error > 0 else "under"
        return f"{side}estimates", f" by {with_error(abs(error), ci95)} %"


def _deviation(factor: Any) -> str:
    """By how much a pressure is off that has to be multiplied by a factor to be right."""
    percent = 100 * (1 / float(factor) - 1)
    if abs(percent) < 0.5:
        return "right"
    return f"{to_two_digits(abs(percent))} % too {'high' if percent > 0 else 'low'}"


def validity(restitution: Any, packing_fraction: Any) -> Validity:
    """Measured stresses, temperatures and dissipation of a flow, what kinetic theory says of them,
    and which fails.

    Args:
      restitution: α, a number or an array.
      packing_fraction: ν, a number or an array; the two broadcast.

    Returns:
      A ``Validity``, whose ``verdict()`` sums it up in words. Its arrays are of NumPy, or of
      JAX if an argument is traced: ``jax.jit``, ``jax.vmap`` and derivatives apply, in double
      precision only, and the result is NaN where a traced value is outside the measured range.

    Raises:
      InputError: (a ValueError) a value is outside the measured range, which the message names; or
        JAX traces it without ``jax_enable_x64``.

    Examples:
      >>> at_point = validity(0.98, 0.5)
      >>> bool(abs(at_point.error["pressure"]) < 0.05)
      True
    """
    table = shipped_table()
    alpha, nu, averages = over_range(
        table, partial(_evaluated, table), restitution, packing_fraction
    )
    return Validity(alpha, nu, *averages)


def _evaluated(table: Table, where: Any, xp: Any) -> tuple[dict[str, Any], ...]:
    """The dictionaries of a ``Validity`` at coordinates in the measured range."""
    measured, ci95, theory, error, error_ci95, corrected, corrected_error, corrected_ci95 = (
        {} for _ in range(8)
    )
    logs = table.series(where, xp)
    for name, estimate in estimates(table, where, xp).items():
        log = logs[CORRECTED + theory_of(name)]
        measured[name], ci95[name] = estimate.value_and_ci95(xp)
        if not name.startswith("local_"):
            theory[name], corrected[name] = xp.exp(estimate.log_theory), xp.exp(log)
        if name != "granular_temperature":
            error[name] = xp.expm1(-estimate.log_ratio)
            error_ci95[name] = xp.exp(-estimate.log_ratio) * xp.sinh(estimate.log_half)
            log_ratio = estimate.log_ratio + estimate.log_theory - log
            corrected_error[name], corrected_ci95[name] = (
                xp.expm1(-log_ratio),
                xp.exp(-log_ratio) * xp.sinh(estimate.log_half),
            )
    value, stderr = table.surfaces["force_ratio"](where, xp)
    measured["force_ratio"] = 1 + excess_from_surface(value, xp)
    sampling = excess_from_surface(HALF_INTERVAL * stderr, xp) * xp.cosh(value)
    ci95["force_ratio"] = xp.hypot(sampling, xp.exp(table.bounds["force_ratio"].mean(where, xp)))
    factors, factors_ci95 = {}, {}
    for name in FACTORS:
        log, stderr = table.surfaces[f"pressure_{name}"](where, xp)
        factors[name], factors_ci95[name] = (
            xp.exp(log),
            xp.exp(log) * xp.sinh(HALF_INTERVAL * stderr),
        )
    corrections = corrected, corrected_error, corrected_ci95
    return measured, ci95, theory, error, error_ci95, *corrections, factors, factors_ci95
