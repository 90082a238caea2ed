"""Runs the loop of the team uncompiled, one thread for each lane, and finds what lanes do to each
other: ``NUMBA_DISABLE_JIT=1 python team_races.py STATE.npz LANES [WITHOUT]``, without the barriers
of a function.

Between two barriers an element that one lane writes may not be touched by another one, unless all
write the same; what lanes exchange without memory is no barrier. All lanes must come to the same
barrier or exchange by the same calls. Prints the number of barriers, and what is wrong.
"""

import sys
import threading
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import numpy as np

from jaxgran.dynamics.numba_engine import layout
from jaxgran.dynamics.numba_engine.arrays import CONSTANTS, CONTACT, ITERATE, MOTION
from jaxgran.dynamics.numba_engine.team import contacts, lanes, loop
from jaxgran.dynamics.numba_engine.team.memory import Clusters, Grains, Memory, Network, Pairs
from jaxgran.dynamics.tally import NUMBERS

lane_here = threading.local()
reads: dict[Any, set[int]] = defaultdict(set)
writes: dict[Any, dict[int, Any]] = defaultdict(dict)
sites: dict[int, tuple] = {}
wrong: set[str] = set()
barriers = 0


class Watched:
    """An array that notes which lane reads and writes which element."""

    def __init__(self, array: np.ndarray, name: str, *before: int) -> None:
        self.array, self.name, self.before = array, name, before
        self.size, self.shape, self.nbytes = array.size, array.shape, array.nbytes

    def __len__(self) -> int:
        return len(self.array)

    def _place(self, index: Any) -> tuple[int, ...]:
        return tuple(int(n) for n in (index if isinstance(index, tuple) else (index,)))

    def __getitem__(self, index: Any) -> Any:
        place = self._place(index)
        if len(place) < self.array.ndim:
            return Watched(self.array[place], self.name, *self.before, *place)
        if self.array.dtype.names:
            return Row(self, place)
        reads[self.name, *self.before, *place].add(lane_here.number)
        return self.array[place]

    def __setitem__(self, index: Any, value: Any) -> None:
        place = self._place(index)
        self.array[place] = value
        writes[self.name, *self.before, *place][lane_here.number] = self.array[place]


class Row:
    """A record of a watched array."""

    def __init__(self, watched: Watched, place: tuple[int, ...]) -> None:
        self.__dict__.update(watched=watched, place=place)

    def __getattr__(self, field: str) -> Any:
        reads[self.watched.name, *self.place, field].add(lane_here.number)
        return self.watched.array[self.place][field]

    def __setattr__(self, field: str, value: Any) -> None:
        self.watched.array[field][self.place] = value
        writes[self.watched.name, *self.place, field][lane_here.number] = value


def replace(**others: Any) -> None:
    """Replace what is compiled for a device, and numbers."""
    for module in (lanes, loop, contacts):
        for name, other in others.items():
            setattr(module, name, other)


def compare_sites() -> None:
    """Called by one lane, while all are at a barrier or an exchange."""
    if len(set(sites.values())) > 1:
        wrong.add(f"lanes wait at different places: {set(sites.values())}")


def compare() -> None:
    """Called by one lane, while all are at a barrier."""
    global barriers
    barriers += 1
    compare_sites()
    for element, by_lane in writes.items():
        differ = len({repr(x) for x in by_lane.values()}) > 1
        if differ or reads.get(element, set()) - set(by_lane):
            where = next(iter(sites.values()))[0]
            wrong.add(f"{element[0]} is written and touched by others before line {where}")
    reads.clear()
    writes.clear()


def fill_the_room() -> None:
    """More contacts are wanted than there is room for; no lane may write beyond it."""
    replace(sync=lambda: None, ballot=lambda team, agrees: np.uint64(agrees))
    written = np.zeros(3, np.int64)
    pairs = SimpleNamespace(calendar=np.array([[0] * 5, [0] * 5, [9] * 5]))
    network = SimpleNamespace(near_pair=written)
    alone = lanes.Team(np.uint64(0), np.uint64(1))
    try:
        found = loop._contacts_of_step(alone, 1, 5, pairs, network)
    except IndexError as problem:
        wrong.add(f"beyond the room: {problem}")
    else:
        if found != 5 or written.tolist() != [0, 1, 2]:
            wrong.add(f"{found} indices are found and {written} written")


def main(file: str, count_of_lanes: int, without: str = "") -> None:
    fill_the_room()
    given = np.load(file)
    meeting = threading.Barrier(count_of_lanes, action=compare)
    exchange = threading.Barrier(count_of_lanes, action=compare_sites)
    words: list[Any] = [None] * count_of_lanes

    def note_site() -> bool:
        """Note the calls of this lane; returns whether they are to be left out."""
        frame: Any = sys._getframe(2)
        left_out, calls = frame.f_code.co_name == without, []
        while frame.f_code.co_name != "run":
            calls.append(frame.f_lineno)
            frame = frame.f_back
        sites[lane_here.number] = tuple(calls)
        return left_out

    def sync() -> None:
        if not note_site():
            meeting.wait(60)

    def words_of_all(word: Any) -> list[Any]:
        note_site()
        words[lane_here.number] = word
        exchange.wait(60)
        given = list(words)
        exchange.wait(60)
        return given

    def of_lane(team, number, lane):
        return words_of_all(number)[int(lane)]

    def ballot(team, agrees) -> np.uint64:
        return np.uint64(sum(bool(x) << n for n, x in enumerate(words_of_all(agrees))))

    def add_terms(sums, first, terms) -> None:
        for n, term in enumerate(terms):
            sums[first + n] += term

    replace(sync=sync, of_lane=of_lane, ballot=ballot, _add_terms=add_terms)
    count = len(given["radii"])
    slots, most = 16 * count, 3 * count

    def watched(name: str, shape: Any, dtype: Any) -> Watched:
        array = np.zeros(shape, dtype)
        array.view(np.uint8)[...] = 0x7F  # not initialised
        return Watched(array, name)

    u4, i4, f8 = np.uint32, np.int32, np.float64
    impulses = watched("impulses", (count, 2), f8)
    memory = Memory(
        Grains(watched("motion", count, MOTION), watched("constants", count, CONSTANTS)),
        Pairs(
            watched("pair ends", (2, slots), u4),
            watched("images", (2, slots), f8),
            watched("calendar", (3, slots), i4),
            watched("listed", slots, u4),
            watched("found", 2 * slots, u4),
            watched("starts", max(9, 2 * count) + 1, u4),
            watched("cells", count, u4),
            watched("sorted", count, u4),
        ),
        Network(
            watched("near_pair", most, u4),
            watched("contact ends", (2, most), u4),
            watched("contact rows", (5, most), f8),
            watched("loaded", count, i4),
            impulses,
            watched("colours", count, u4),
            watched("colour", most, u4),
        ),
        Clusters(
            watched("source", most, u4),
            watched("starts", 33, u4),
            watched("solver ends", (most, 2), u4),
            watched("solver rows", most, CONTACT),
            watched("iterate", most, ITERATE),
            impulses,
            watched("matrices", (count, 3), f8),
        ),
        watched("sums", (count_of_lanes, NUMBERS), f8),
    )
    steps = given["steps"]
    inputs = layout.Inputs(*given["inputs"])
    new = [watched("new positions", (count, 2), f8), watched("new velocities", (count, 2), f8)]
    results = watched("results", (steps.size, layout.RESULTS), f8)

    def run(number: int) -> None:
        lane_here.number = number
        arrays = (given[x] for x in ("positions", "velocities", "radii", "masses"))
        try:
            loop.advance_team(
                lanes.Team(np.uint64(number), np.uint64(count_of_lanes)),
                *arrays,
                inputs,
                steps,
                given["begin"],
                *new,
                results,
                memory,
            )
        except BaseException as problem:
            wrong.add(f"lane {number}: {problem!r}")
            meeting.abort()
            exchange.abort()
            raise

    threads = [threading.Thread(target=run, args=(n,)) for n in range(count_of_lanes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    np.savez(file.replace(".npz", "_end.npz"), results=results.array, positions=new[0].array)
    print(barriers, *sorted(wrong), sep="\n")


if __name__ == "__main__":
    np.seterr(all="ignore")
    # few sweeps, so that the method that follows them is needed
    replace(bits_of=lambda word: int(word).bit_count(), SWEEPS=3)
    main(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])
