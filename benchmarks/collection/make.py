"""The collection of contact problems: about 200 from 2 to 3000 contacts, with solutions that are
proved.

python -m benchmarks collection                  # benchmarks/results/collection.h5 and a table of
what is in it python -m benchmarks collection --quick          # few problems of each kind

The same seeds give the same bytes on one machine. ``files`` has the layout, ``certificates`` says
how the solutions are computed and proved. Nothing here is timed.
"""

import hashlib
from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran as jg
from benchmarks.collection.certificates import Problem, Solved, centre, obstructed, solved
from benchmarks.collection.files import Entry, write
from benchmarks.collection.problems import Made, problems
from benchmarks.networks import SLOTS
from benchmarks.output import Output

UNIQUE, WORST = (
    1e-20,
    1e-13,
)  # natural residuals: above the first a solution is not unique, the last is refused
_GUESS = jg.BarzilaiBorwein(tolerance=1e-10, max_steps=500_000)


def run(output: Output) -> None:
    """Make the problems, solve and prove them, and write the file and its summary."""
    entries = list(made(problems(output.quick)))
    path = output.path("collection", ".h5")
    write(path, entries)
    rows = summary(entries)
    print(table(rows))
    content = path.read_bytes()
    head = {
        "problems": len(entries),
        "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(),
        "bound_of_entries_over_bound_of_grains": bounds(entries),
    }
    output.write_rows("collection", head, "families", rows)


def made(collection: Iterable[Made]) -> Iterable[Entry]:
    """The problems with their solutions, under numbered names."""
    for number, (family, origin, problem) in enumerate(collection):
        name = f"{number:03d} {family}, {len(problem.approach)} contacts"
        yield Entry(name, family, origin, problem, proved(problem))


def proved(problem: Problem) -> Solved:
    """The solution of a problem, or weights that prove that it has none.

    Raises:
      ArithmeticError: neither could be proved.
    """
    guess = _guess(padded(problem), solver=_GUESS)
    count = len(problem.approach)
    result = obstructed(problem) if guess.status == jg.Status.infeasible else None
    if result is None:
        result = solved(problem, np.asarray(guess.impulses)[:count])
        if (
            result.certificate["natural_map"] > UNIQUE
            and (middle := centre(problem).impulses) is not None
        ):
            result = min(
                result, solved(problem, middle), key=lambda x: x.certificate["natural_map"]
            )
        if not result.certificate["natural_map"] <= WORST:
            raise ArithmeticError(f"no certificate for {count} contacts: {result.certificate}")
    return result


_guess = jax.jit(jg.solve_contacts)
_bound_of_grains = jax.jit(lambda network: network.operator().spectral_bound())


def padded(problem: Problem) -> jg.ContactNetwork:
    """The problem in one of few shapes, so that few are compiled."""
    slots = min(slots for slots in SLOTS if slots >= len(problem.approach))

    def pad(values: np.ndarray, size: int, fill: float) -> jax.Array:
        places = [(0, size - len(values))] + [(0, 0)] * (values.ndim - 1)
        return jnp.asarray(np.pad(values, places, constant_values=fill))

    return jg.ContactNetwork(
        pad(problem.ends, slots, 0),
        pad(problem.normals, slots, 0),
        pad(problem.masses, 2 * slots, 1),
        pad(problem.approach, slots, 0),
    )


def summary(entries: list[Entry]) -> list[dict]:
    """What is in each family, and the worst of its certificates."""
    families: dict[tuple[str, bool], list[Entry]] = {}
    for entry in entries:
        families.setdefault((entry.family, entry.solution.feasible), []).append(entry)
    rows = []
    for (family, feasible), members in families.items():
        sizes = [len(member.problem.approach) for member in members]
        row = {"family": family, "problems": len(members), "feasible": feasible}
        row |= {"fewest_contacts": min(sizes), "most_contacts": max(sizes)}
        for key in members[0].solution.certificate:
            values = [member.solution.certificate[key] for member in members]
            row[f"{key}_median"], row[f"{key}_worst"] = (
                float(f"{f(values):.2g}") for f in (np.median, max)
            )
        rows.append(row)
    return rows


def bounds(entries: list[Entry]) -> dict[str, float]:
    """The diagonal bound of W from its entries over that from the grains: median and largest mean
    of a problem.
    """
    ratios = []
    for entry in entries:
        network, matrix = padded(entry.problem), entry.matrix
        root = np.sqrt(matrix.diagonal())
        of_entries = root * (abs(matrix) @ (1 / root))
        of_grains = np.asarray(_bound_of_grains(network))[: len(root)]
        ratios.append(float(np.mean(of_entries / of_grains)))
    return {"median": float(f"{np.median(ratios):.4g}"), "largest": float(f"{max(ratios):.4g}")}


def table(rows: list[dict]) -> str:
    """The families as lines of text."""
    lines = [f"{'family':20s} problems  contacts     worst certificate"]
    for row in rows:
        key = "natural_map" if row["feasible"] else "obstacle"
        sizes = f"{row['fewest_contacts']}–{row['most_contacts']}"
        lines.append(
            f"{row['family']:20s} {row['problems']:8d}  {sizes:11s}  {key} "
            f"{row[f'{key}_worst']:.1e}"
        )
    return "\n".join(lines)
