"""The mistakes that ``mutants`` makes: one word each, such as a sign, a factor or an index, in all layers.

Each changes a number that a user can see. A mistake that only makes a solve slower belongs in a benchmark of speed.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Mistake:
    """A line of a file with one word changed.

    ``before`` and ``after`` are the line without its indentation, or the part of it that is unique in its file.
    ``breaks`` is the law that no longer holds. ``tests`` are the files in which it should be found, the nearest first.
    """

    name: str
    file: str
    before: str
    after: str
    breaks: str
    tests: tuple[str, ...]

    def made_in(self, text: str) -> str:
        """The text of the file with the mistake; ValueError unless its line is there exactly once."""
        if text.count(self.before) != 1:
            raise ValueError(f"{self.file} has the line of the mistake {self.name!r} {text.count(self.before)} times")
        return text.replace(self.before, self.after)


_ENGINES = ("test_dynamics.py", "test_physics.py", "test_native.py")

MISTAKES = (
    Mistake(
        "tolerance not squared",
        "jaxgran/dynamics/numba_engine/loop.py",
        "iterations, squared, spare, outcome = 1, 0.0, target * target, OK",
        "iterations, squared, spare, outcome = 1, 0.0, target * scale, OK",
        "a solve ends when its residual is below the tolerance; here, below the root of it",
        _ENGINES,
    ),
    Mistake(
        "skin of one grain",
        "jaxgran/dynamics/numba_engine/near_pairs.py",
        "return 2 * fastest * (1 + LIFE) + rate * distance / 2",
        "return 1 * fastest * (1 + LIFE) + rate * distance / 2",
        "a list of near pairs holds until two of the fastest grains could have crossed its skin",
        _ENGINES,
    ),
    Mistake(
        "half of a closing gap",
        "jaxgran/dynamics/numba_engine/calendar.py",
        "late = (excess > 0.0) & (excess + 2 * closing * horizon > 0.0)",
        "late = (excess > 0.0) & (excess + 1 * closing * horizon > 0.0)",
        "every contact that begins while a list is valid is in the calendar",
        _ENGINES,
    ),
    Mistake(
        "mass of the other grain",
        "jaxgran/dynamics/numba_engine/cluster_solver.py",
        "rows[c, INVERSE_MU_MI], rows[c, INVERSE_MU_MJ], rows[c, P] = mobility * mi, mobility * mj, 0.0",
        "rows[c, INVERSE_MU_MI], rows[c, INVERSE_MU_MJ], rows[c, P] = mobility * mi, mobility * mi, 0.0",
        "an impulse changes the velocity of a grain by its own mass",
        _ENGINES,
    ),
    Mistake(
        "ends of a chain",
        "jaxgran/dynamics/numba_engine/sums.py",
        "impulse if loaded[i] > 1 or loaded[j] > 1 else 0.0,",
        "impulse if loaded[i] > 1 and loaded[j] > 1 else 0.0,",
        "the moment of clusters counts a contact of which either grain feels another one",
        _ENGINES,
    ),
    Mistake(
        "mean square of a strain",
        "jaxgran/contact/law.py",
        "return xx - strain * xy + strain * strain / 3 * yy, xy - strain / 2 * yy, yy",
        "return xx - strain * xy + strain * strain / 2 * yy, xy - strain / 2 * yy, yy",
        "the kinetic stress is the exact mean along a flight; all engines share this line, so they agree",
        ("test_tally.py", *_ENGINES),
    ),
    Mistake(
        "skin given back",
        "jaxgran/dynamics/jax_engine.py",
        "lists, slack = replace(lists, frame=frame), slack - loss * flight",
        "lists, slack = replace(lists, frame=frame), slack + loss * flight",
        "flight uses up the skin of a list, which is then renewed",
        _ENGINES,
    ),
    Mistake(
        "branch of another replica",
        "jaxgran/model/control_flow.py",
        "where_active(mine, take(mine), result)",
        "where_active(branch, take(mine), result)",
        "a replica of a batch has the same bits whatever the others do",
        ("test_dynamics.py", "test_batch.py"),
    ),
    Mistake(
        "sign of a changed approach",
        "jaxgran/contact/solver.py",
        "wanted = jnp.where(pressing, -(response_change + change.approach), 0)",
        "wanted = jnp.where(pressing, -(response_change - change.approach), 0)",
        "derivatives of the impulses are those of finite differences",
        ("test_gradients.py",),
    ),
    Mistake(
        "matrix of the other grain",
        "jaxgran/contact/delassus.py",
        "taken(largest, contacts.j) * contacts.inverse_mass_j",
        "taken(largest, contacts.i) * contacts.inverse_mass_j",
        "the diagonal bounds the Delassus operator, without which a solve may diverge",
        ("test_solver.py", "test_networks.py"),
    ),
    Mistake(
        "row of neighbours",
        "jaxgran/contact/cell_list.py",
        "_HALF_STENCIL = np.array([[0, 0], [1, 0], [-1, 1], [0, 1], [1, 1]], np.int32)",
        "_HALF_STENCIL = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [1, 1]], np.int32)",
        "each pair of neighbours is found, and once",
        ("test_neighbours.py", "test_pairs.py"),
    ),
    Mistake(
        "sign of the tilt",
        "jaxgran/model/cell.py",
        "x = x - rows * tilt * side",
        "x = x + rows * tilt * side",
        "a grain that leaves through the top comes back displaced against the tilt",
        ("test_cell.py",),
    ),
    Mistake(
        "component yx",
        "jaxgran/dynamics/tally.py",
        "return taken(numbers, jnp.asarray([0, 1, 1, 2])).reshape(2, 2)",
        "return taken(numbers, jnp.asarray([0, 1, 2, 2])).reshape(2, 2)",
        "stress tensors are symmetric",
        ("test_tally.py", "test_physics.py"),
    ),
    Mistake(
        "collisions counted by pairs",
        "jaxgran/sampling/averages.py",
        '"collision_rate": 2 * tally.collisions / (grains * tally.duration * shear_rate),',
        '"collision_rate": 1 * tally.collisions / (grains * tally.duration * shear_rate),',
        "a collision is one of both of its grains",
        ("test_observables.py",),
    ),
    Mistake(
        "one degree of freedom",
        "jaxgran/statistics.py",
        "variance = squares / (2 * half - 2) * 2 / half",
        "variance = squares / (2 * half - 1) * 2 / half",
        "the error of a drift is without bias in short records, as two means are taken from the data",
        ("test_statistics.py", "test_protocol.py"),
    ),
    Mistake(
        "fewest groups",
        "jaxgran/statistics.py",
        "if seeds * (blocks // m) >= (2 if m == 1 else _FEWEST_GROUPS)]",
        "if seeds * (blocks // m) > (2 if m == 1 else _FEWEST_GROUPS)]",
        "an error is the largest over all merges that leave at least four groups",
        ("test_statistics.py", "test_docs.py"),
    ),
    Mistake(
        "late part of a record",
        "jaxgran/sampling/steady_state.py",
        "late = np.stack(record[chunks // 3 :])",
        "late = np.stack(record[chunks // 2 :])",
        "a flow is steady by the last two thirds of its record",
        ("test_protocol.py", "test_ratio_map.py"),
    ),
    Mistake(
        "unit of a time step",
        "jaxgran/maps/dataset.py",
        '"long_name": "time step of the sample", "units": "1 / shear rate"}',
        '"long_name": "time step of the sample", "units": "1"}',
        "an attribute has the unit of its variable",
        ("test_dataset.py", "test_ratio_map.py", "test_engine.py"),
    ),
    Mistake(
        "strain of a kept replica",
        "jaxgran/maps/checkpoint.py",
        "replicas[point, seed] = Replica(sample, status, float(strain), instant)",
        "replicas[point, seed] = Replica(sample, status, float(area), instant)",
        "what was kept of an unfinished map comes back as it was",
        ("test_checkpoint.py",),
    ),
    Mistake(
        "kurtosis in a rate",
        "jaxgran/theory/navier_stokes.py",
        "collision_rate=maxwellian_collision_rate(density, chi, temperature) * (1 - kurtosis / 16) / rate,",
        "collision_rate=maxwellian_collision_rate(density, chi, temperature) * (1 + kurtosis / 16) / rate,",
        "velocities that are not Gaussian collide less often; a rate at α = 0.5 changes by 1 %",
        ("test_kinetic_theory.py", "test_theory_figures.py"),
    ),
)
QUICK = ("sign of the tilt", "fewest groups", "strain of a kept replica")
