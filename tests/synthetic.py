"""Made-up tallies and replicas, for tests of what happens to the numbers after the flow."""

import numpy as np

from jaxgran.dataset import Replica
from jaxgran.measure import BLOCKS, Sample
from jaxgran.settings import MapSettings
from jaxgran.status import Status
from jaxgran.tally import Tally


def random_tally(rng: np.random.Generator, *shape: int, status: int = 0) -> Tally:
    """Return a tally of positive random sums, of whole numbers of steps and contacts, with any leading axes."""
    counts = ("steps", "contacts", "loaded_contacts", "collisions", "solves", "iterations", "unconverged")
    values = {}
    for name in Tally.__dataclass_fields__:
        tail = (2, 2) if name.endswith("moment") else (64,) if name == "residual_counts" else ()
        values[name] = rng.gamma(20.0, 1.0, (*shape, *tail))
        if name in counts:
            values[name] = np.ceil(values[name])
    return Tally(**{**values, "status": np.full(shape, status, np.int32)})


def random_replica(rng: np.random.Generator, settings: MapSettings, status: int = Status.ok) -> Replica:
    """Return a replica of a map with random sums, the same area for all and a strain of 3 before the sample."""
    tally = random_tally(rng, BLOCKS, status=status)
    return Replica(Sample(tally, np.float64(100.0), np.float64(1.0), settings.grains), int(status), 3.0)


def one_sentence(message: str) -> bool:
    """Whether a message is one line that starts with a word and ends with a full stop."""
    return message.count("\n") == 0 and message.endswith(".") and not message.endswith("..")
