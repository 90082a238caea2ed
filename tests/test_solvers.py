"""Contact solvers side by side: problems as others pose them, what is judged and counted, and the
figure.
"""

import numpy as np
import pytest
from test_collection import entry_of

from benchmarks import networks
from benchmarks.collection import Entry
from benchmarks.collection.certificates import delassus
from benchmarks.solvers.forms import program_of, weighted


@pytest.fixture(scope="module")
def entries() -> list[Entry]:
    return [
        entry_of("chain", networks.chain(16)),
        entry_of("size ratio 10", networks.size_ratio(1, 0)),
        entry_of("mass ratio 10000", networks.mass_ratio(4, 0)),
        entry_of("hexagonal cluster", networks.hexagonal(2, True)),
        entry_of("jammed row", networks.jammed_row(10)),
    ]


def test_solution_is_optimal_for_the_quadratic_program(entries):
    for entry in entries[:4]:
        program = program_of(entry)
        slope = program.scale * (program.p @ (entry.solution.impulses / program.scale) + program.q)
        np.testing.assert_allclose(slope, entry.solution.velocities, atol=1e-12)
        g = weighted(entry)
        np.testing.assert_allclose(
            (g @ g.T).toarray(), delassus(entry.problem).toarray(), atol=1e-12
        )
