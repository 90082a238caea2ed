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
from jaxgran.reference.evaluation import Estimate, from_log, over_range
from jaxgran.reference.table import (
    CORRECTED,
    MEASURED,
    RATIO,
    Table,
    excess_from_surface,
    shipped_table,
    theory_of,
)
from jaxgran.theory.assumptions import ASSUMPTIONS, NEGLIGIBLE

COLUMNS = ("average", "measured", "theory", "error", "error if corrected")
"""What ``Validity.rows`` gives of every average."""

_BINARY = 0.05  # excess of the force ratio below which collisions are said to be binary


class Validity(NamedTuple):
    """What was measured at a restitution and a packing fraction, and what kinetic theory says.

    Measured averages, errors and factors are estimates: ``value`` and ``ci95``, the half-width of
    its 95 % interval. All arrays have the shape to which restitution and packing fraction
    broadcast; () for two numbers.

    ===============  ===============================================================================
    field            content
    ===============  ===============================================================================
    measured         estimates by name: pressure and shear_stress in m/t², granular_temperature and
                     local_granular_temperature in m(σ/t)², dissipation_rate in m/t³, force_ratio.
                     Their intervals contain sampling, interpolation, time step, tolerance, and the
                     difference from a large system
    theory           pressure, shear_stress, granular_temperature and dissipation_rate of kinetic
                     theory, same units
    error            theory over measured, less one, of all but the granular temperature and the
                     force ratio; the theory's temperature is compared with the local one
    corrected        the predictions of ``corrected_shear``, with measured laws of correlations and
                     pairs
    corrected_error  the same errors of these
    factors          the assumptions of Enskog's contact pressure at the measured granular
                     temperature, by name: factors whose product is the measured contact pressure
                     over Enskog's (``sampling.enskog_factors``); from sampling and interpolation at
                     the number of grains of the map
    ===============  ===============================================================================
    """

    restitution: Any
    packing_fraction: Any
    measured: dict[str, Estimate]
    theory: dict[str, Any]
    error: dict[str, Estimate]
    corrected: dict[str, Any]
    corrected_error: dict[str, Estimate]
    factors: dict[str, Estimate]

    def __repr__(self) -> str:
        """Where it is, and the measured averages with ± half-widths of 95 % intervals."""
        where = {"restitution": self.restitution, "packing_fraction": self.packing_fraction}
        measured = {name: WithError(*estimate) for name, estimate in self.measured.items()}
        return text_of("Validity", where | measured)

    def fails_first(self) -> Any:
        """The name of the factor that is furthest from one, in logarithm; "none" where all are
        within 2 % of one.

        For values that are known, not traced by JAX: a string, or an array of strings.
        """
        logs = np.abs(np.log([self.factors[name].value for name in ASSUMPTIONS]))
        names = np.array([*ASSUMPTIONS], object)[np.argmax(logs, axis=0)]
        failing = np.where(np.max(logs, axis=0) > NEGLIGIBLE, names, "none")
        return failing if failing.ndim else str(failing)

    def over_enskog(self) -> Any:
        """The measured contact pressure over Enskog's at the measured granular temperature."""
        return math.prod(self.factors[name].value for name in ASSUMPTIONS)

    def at(self, place: Any) -> "Validity":
        """One flow of an array of flows, or a part of them; for values that are known, not
        traced.
        """

        def part(x: Any) -> Any:
            if isinstance(x, dict):
                return {name: part(value) for name, value in x.items()}
            return type(x)(*map(part, x)) if isinstance(x, tuple) else np.asarray(x)[place]

        return part(self)

    def verdict(self) -> Any:
        """The answer in words for every flow: a string, or an array of strings. Values must not
        be traced.
        """
        verdicts = np.empty(np.shape(self.error["pressure"].value), object)
        for place in np.ndindex(verdicts.shape):
            verdicts[place] = _verdict(self.at(place))
        return verdicts if verdicts.ndim else verdicts.item()

    def rows(self) -> list[list[str]]:
        """The ``COLUMNS`` of every average of one flow, as texts; an average and an error with a 95
        % interval.
        """
        rows = []
        for name, (value, ci95) in self.measured.items():
            row = [name.replace("_", " "), with_error(float(value), float(ci95)), "", "", ""]
            if name in self.error:
                row[2] = f"{self.theory[name.removeprefix('local_')]:.4g}"
                errors = self.error[name], self.corrected_error[name]
                row[3:] = [_percent(float(error), float(ci95)) for error, ci95 in errors]
            rows.append(row)
        return rows


def _verdict(flow: Validity) -> str:
    """The verdict on one flow."""
    names = "pressure", "local_granular_temperature"
    (verb, amount), (verb_of_temperature, amount_of_temperature) = (
        _departure(*map(float, flow.error[name])) for name in names
    )
    again = "" if verb == verb_of_temperature else f"{verb_of_temperature} "
    first, enskog = flow.fails_first(), "Enskog's contact pressure"
    if first == "none":
        within = f"{100 * NEGLIGIBLE:g} %"
        cause = f"Each of its assumptions holds within {within}; all together make {enskog}"
    else:
        cause = (
            f"The largest error comes from assuming that {ASSUMPTIONS[first].statement}: alone "
            f"it makes {enskog} {_deviation(flow.factors[first].value)}; all together make it"
        )
    ratio, ratio_ci95 = map(float, flow.measured[RATIO])
    excess = max(ratio - 1, 0.0) + ratio_ci95
    step = f"dt = {shipped_table().timestep}/γ̇"
    if excess < _BINARY:
        most = 1 + float(f"{excess:.1g}")
        binary = f"Collisions are binary (force ratio at most {most:g}, {step})"
    else:
        binary = f"Binary collisions explain {100 / ratio:.2g} % of the mean contact force ({step})"
    return (
        f"Kinetic theory {verb} the pressure{amount} and {again}the local temperature"
        f"{amount_of_temperature}. {cause} {_deviation(flow.over_enskog())} at the measured "
        f"temperature; the rest is the error of the temperature. {binary}."
    )


def _departure(error: float, ci95: float) -> tuple[str, str]:
    """What the theory does with an average: a verb, and by how much."""
    if abs(error) <= ci95:
        return "agrees with", f" (error {_percent(error, ci95)})"
    verb = "overestimates" if error > 0 else "underestimates"
    return verb, f" by {_percent(abs(error), ci95)}"


def _percent(error: float, ci95: float) -> str:
    return f"{with_error(100 * error, 100 * ci95)} %"


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
      >>> bool(abs(at_point.error["pressure"].value) < 0.05)
      True
    """
    table = shipped_table()
    alpha, nu, answer = over_range(table, partial(_answer, table), restitution, packing_fraction)
    return Validity(alpha, nu, *answer)


def _answer(table: Table, where: Any, xp: Any) -> tuple[dict[str, Any], ...]:
    """The dictionaries of a ``Validity`` at coordinates in the measured range."""
    measured, theory, error, corrected, corrected_error = {}, {}, {}, {}, {}
    logs = table.series(where, xp)
    for name in MEASURED:
        log, half = table.log_estimate(name, where, xp)
        log_theory, log_corrected = (logs[x + theory_of(name)] for x in ("", CORRECTED))
        measured[name] = from_log(log + log_theory, half, xp)
        if not name.startswith("local_"):
            theory[name], corrected[name] = xp.exp(log_theory), xp.exp(log_corrected)
        if name != "granular_temperature":
            error[name] = _less_one(-log, half, xp)
            corrected_error[name] = _less_one(-(log + log_theory - log_corrected), half, xp)
    value, stderr = table.surfaces[RATIO](where, xp)
    sampling = excess_from_surface(HALF_INTERVAL * stderr, xp) * xp.cosh(value)
    ci95 = xp.hypot(sampling, xp.exp(table.bounds[RATIO].mean(where, xp)))
    measured[RATIO] = Estimate(1 + excess_from_surface(value, xp), ci95)
    factors = {
        name: from_log(*table.log_estimate(f"pressure_{name}", where, xp), xp)
        for name in ASSUMPTIONS
    }
    return measured, theory, error, corrected, corrected_error, factors


def _less_one(log: Any, half: Any, xp: Any) -> Estimate:
    """A quotient less one, from its logarithm."""
    return Estimate(xp.expm1(log), from_log(log, half, xp).ci95)
