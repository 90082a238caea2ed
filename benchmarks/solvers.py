"""Iterations and time of the projected methods on contact networks of flows.

Two networks of each flow (N = 256, dt = 1e-3) are solved to two residuals: of twenty instants those
in which most grains approach. Compiled for one shape, and run by JAX on one core. An iteration is
one product with W. The error of the stress of a solve, Σ J n⊗n over that of a solve to 1e-12, is
given over its tolerance.

    python -m benchmarks solvers          # a minute
    python -m benchmarks solvers --quick  # two flows, half a minute
"""

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.output import Output
from benchmarks.timing import timed
from jaxgran.contact.solve_contacts import ContactSolution
from jaxgran.model.status import Status

ONE_CORE = True

RESTITUTIONS, PACKING_FRACTIONS = (0.9, 0.5, 0.1), (0.7, 0.8, 0.82)
GRAINS, TIMESTEP = 256, 1e-3
STRAIN, INSTANTS, CHOSEN = 2.0, 20, 2
METHODS = {"Jacobi": jg.Jacobi, "Nesterov": jg.Nesterov, "Barzilai–Borwein": jg.BarzilaiBorwein}
TOLERANCES, EXACT, CAP = (1e-4, 1e-6), 1e-12, 100_000
solve = jax.jit(jg.solve_contacts)


def run(output: Output) -> None:
    """Solve the networks of every flow, print, and write ``solvers`` as JSON."""
    flows = list(product(RESTITUTIONS, PACKING_FRACTIONS))
    rows = []
    for alpha, nu in flows[:2] if output.quick else flows:
        networks = networks_of(alpha, nu)
        exact = [stress(network, jg.BarzilaiBorwein(EXACT, CAP))[0] for network in networks]
        contacts = [int(jnp.sum(jnp.any(network.normals != 0, axis=-1))) for network in networks]
        head = {"restitution": alpha, "packing_fraction": nu, "contacts": float(np.mean(contacts))}
        for (name, method), tolerance in product(METHODS.items(), TOLERANCES):
            costs = cost(networks, method(tolerance, CAP), exact)
            rows.append(head | {"method": name, "tolerance": tolerance} | costs)
            print(rows[-1], flush=True)
    head = {"grains": GRAINS, "timestep": TIMESTEP, "networks": CHOSEN, "cap": CAP}
    output.write_json("solvers", head | {"rows": rows})


def networks_of(alpha: float, nu: float) -> list[jg.ContactNetwork]:
    """The contact networks of a steady flow in which most grains approach."""
    flow = jg.ShearFlow(GRAINS, alpha, nu, TIMESTEP)
    state = jg.prepare(flow, jax.random.key(0))
    contacts = jg.snapshot_series(flow, state, STRAIN, INSTANTS)[1].contacts
    busiest = np.argsort(np.sum(np.asarray(contacts.approach) < 0, axis=1))[-CHOSEN:]
    return [
        jg.ContactNetwork(
            jnp.stack([contacts.i[k], contacts.j[k]], axis=-1),
            contacts.normals[k],
            state.grains.masses,
            contacts.approach[k],
        )
        for k in busiest
    ]


def cost(
    networks: list[jg.ContactNetwork], method: jg.ProjectedMethod, exact: list[np.ndarray]
) -> dict[str, float]:
    """Mean iterations and seconds of a solve, and the largest error of its stress over its
    tolerance.
    """
    iterations, seconds, errors = [], [], []
    for network, true in zip(networks, exact, strict=True):
        value, solution = stress(network, method)
        if solution.status != Status.ok:
            raise ArithmeticError(f"{method} ends with {Status(int(solution.status)).name}")
        iterations.append(int(solution.iterations))
        call = partial(solve, network, solver=method)
        seconds.append(timed(lambda call=call: jax.block_until_ready(call()))[0])
        errors.append(np.linalg.norm(value - true) / np.linalg.norm(true) / method.tolerance)
    return {
        "iterations": float(np.mean(iterations)),
        "seconds": float(np.mean(seconds)),
        "stress_error": float(np.max(errors)),
    }


def stress(
    network: jg.ContactNetwork, method: jg.ProjectedMethod
) -> tuple[np.ndarray, ContactSolution]:
    """Σ J n⊗n, the stress of grains of one size, and the solution."""
    solution = solve(network, solver=method)
    normals = np.asarray(network.normals)
    return np.einsum("c,ca,cb", solution.impulses, normals, normals), solution
