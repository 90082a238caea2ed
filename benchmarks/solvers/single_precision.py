"""The projected methods in single precision."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.collection import Entry
from benchmarks.collection.compare import CAP, Answer, Solve, solved_network
from benchmarks.collection.make import padded
from jaxgran.contact.projected_methods import ProjectedMethod
from jaxgran.model.status import Status


def projected_in_float32(method: ProjectedMethod, entry: Entry, tolerance: float) -> Solve:
    """As ``benchmarks.collection.compare.projected``, with all numbers of the problem in single precision."""
    network = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == float else x, padded(entry.problem))
    count = len(entry.problem.approach)
    call = partial(solved_network, network, replace(method, tolerance=tolerance, max_steps=CAP))

    def solve() -> Answer | None:
        solution = jax.block_until_ready(call())
        if solution.status == Status.infeasible:
            return None
        return Answer(np.asarray(solution.impulses, float)[:count], int(solution.iterations))

    return solve
