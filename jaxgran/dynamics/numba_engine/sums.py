"""The running sums of the numba engine, in one row of numbers ordered by the table of
``dynamics.tally``.
"""

from jaxgran.contact.law import SolvedContact
from jaxgran.dynamics.numba_engine.compilation import LAW, njit
from jaxgran.dynamics.numba_engine.layout import (
    APPROACH,
    DISTANCE,
    FIRST,
    IMPULSE,
    NX,
    NY,
    OK,
    SECOND,
)
from jaxgran.dynamics.tally import CONTACT, place_of, span_of

contact_terms, kinetic_means = LAW["contact_terms"], LAW["kinetic_means"]

FIRST_TERM, TERMS = span_of(CONTACT).start, span_of(CONTACT).stop - span_of(CONTACT).start
_PADDED = (TERMS + 7) // 8 * 8  # the terms are added eight at a time
# Terms that fill the last eight, and are added to nothing: zeros in their place cost 3 to 6 % of a
# step.
_PADS = _PADDED - TERMS
_DURATION, _STEPS, _KINETIC = place_of("duration"), place_of("steps"), place_of("kinetic_moment")
COLLISIONS = place_of("collisions")
_SOLVES, _ITERATIONS = place_of("solves"), place_of("iterations")
_UNCONVERGED = place_of("unconverged")
LARGEST_OVERLAP, _WORST_RESIDUAL = place_of("largest_overlap"), place_of("worst_residual")


@njit
def add_flight(sums, steps, flight, strain, kinetic):
    """Add a flight of so many steps, with Σ m c ⊗ c at its beginning, and return that at its end.

    ``strain`` is the strain of the flight, in which c_x falls by γ̇ c_y t.
    """
    xx, xy, yy = kinetic
    mean_xx, mean_xy, mean_yy = kinetic_means(xx, xy, yy, strain)
    sums[_DURATION] += flight
    sums[_STEPS] += steps
    sums[_KINETIC] += flight * mean_xx
    sums[_KINETIC + 1] += flight * mean_xy
    sums[_KINETIC + 2] += flight * mean_yy
    return xx + strain * (strain * yy - 2 * xy), xy - strain * yy, yy


@njit
def add_contacts(sums, contacts, one_plus_alpha, grains, network):
    """Add what the contacts of one step contribute, by the law of a contact."""
    step_sums = network.step_sums
    for n in range(_PADDED):
        step_sums[n] = 0.0
    for c in range(contacts):
        terms = terms_of(c, one_plus_alpha, grains, network)
        padded = terms[:] + terms[:_PADS]
        for n in range(_PADDED):
            step_sums[n] += padded[n]
    for n in range(TERMS):
        sums[FIRST_TERM + n] += step_sums[n]


@njit
def terms_of(c, one_plus_alpha, grains, network):
    """What a contact contributes, from the impulses on its grains."""
    ends, rows, constants = network.ends, network.rows, grains.constants
    impulses, loaded = network.impulses, network.loaded
    i, j = ends[FIRST, c], ends[SECOND, c]
    nx, ny, approach, distance = rows[NX, c], rows[NY, c], rows[APPROACH, c], rows[DISTANCE, c]
    mi, mj = constants[i].inverse_mass, constants[j].inverse_mass
    impulse = one_plus_alpha * rows[IMPULSE, c]
    change = nx * (impulses[i, 0] * mi - impulses[j, 0] * mj) + ny * (
        impulses[i, 1] * mi - impulses[j, 1] * mj
    )
    contact = SolvedContact(
        nx=nx,
        ny=ny,
        distance=distance,
        overlap=max(constants[i].radius + constants[j].radius - distance, 0.0),
        approach=approach,
        half_change=change / 2,
        one_plus_alpha=one_plus_alpha,
        impulse=impulse,
        binary_impulse=-one_plus_alpha * min(approach, 0.0) / (mi + mj),
        clustered=impulse if loaded[i] > 1 or loaded[j] > 1 else 0.0,
        used=1.0,
        loaded=1.0 if impulse > 0.0 else 0.0,
        approaching=1.0 if approach < 0.0 else 0.0,
    )
    return contact_terms(contact)


@njit
def add_solve(sums, iterations, residual, status, overlap):
    """Add one solve."""
    sums[_SOLVES] += 1
    sums[_ITERATIONS] += iterations
    sums[_UNCONVERGED] += status != OK
    sums[LARGEST_OVERLAP] = max(sums[LARGEST_OVERLAP], overlap)
    sums[_WORST_RESIDUAL] = max(sums[_WORST_RESIDUAL], residual)
