"""What can go wrong in a replica, in order of severity; the worst status is kept."""

from enum import IntEnum
from typing import Any


class Status(IntEnum):
    """Outcome of a replica; a larger value is worse. Compiled code carries it as an int32.

    Examples:
      >>> max(Status.ok, Status.not_steady, Status.iteration_limit).name
      'not_steady'
    """

    ok = 0
    iteration_limit = 1  # a contact solve ended above the tolerance
    imprecise = 2  # the error is larger than the requested one
    short_sample = 3  # the sample lasts a few correlation strains; its errors may be too small
    not_steady = 4  # the flow was not shown to be steady
    deep_overlap = 5  # contacts overlapped by too large a part of the gap between grains
    infeasible = 6  # no impulses satisfy the contact law: the packing is jammed
    capacity = 7  # more pairs or contacts than the buffers hold
    nonfinite = 8  # a number is not finite, or the packing fraction is not that of the state
    failed = 9  # workers of a cluster died of it, and it was given up


GIVEN_UP = Status.infeasible  # from here on a replica is advanced no further, and has no averages
DEEP_OVERLAP = 1e-2  # σ, of a single contact
# |Σ m c| over Σ m |c|, of which temperature and stresses contain about the square
LARGEST_DRIFT = 1e-2


def worse(status: Any, condition: Any, other: Status) -> Any:
    """The worse of a status and another one that holds under a condition, of JAX where they are."""
    is_worse = (condition & (status < other.value)).astype(status.dtype)
    return status + is_worse * (other.value - status)


MEANINGS = {
    "iteration_limit": "some contact solve ended above the tolerance",
    "imprecise": "the error of a large system is larger than the requested one, take more seeds, "
    "more grains or a larger error",
    "short_sample": "the sample lasts only a few correlation strains, so its errors may be too "
    "small",
    "not_steady": "temperature, pressure or total momentum still drifted, or `equilibrate` is "
    "below the correlation strain, sample or prepare longer",
    "deep_overlap": "contacts overlap by too large a part of the gap between grains, so that the "
    "pressure may be off by more than 3 %, take a shorter time step",
    "infeasible": "no impulses satisfy the contact law, the packing is jammed, lower the packing "
    "fraction",
    "capacity": "more pairs or contacts than the buffers hold, take a shorter time step",
    "nonfinite": "a number of the flow, its state or its sums is not finite or out of its range, "
    "or the packing fraction is not that of the state",
    "failed": "workers of a cluster died of it, perhaps for lack of memory; pass `resume=True` to "
    "try once more",
    "not_run": "the point was not run",
}
"""What each status means for a user, and what to do."""
