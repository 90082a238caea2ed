"""Runs the loop of the team uncompiled, one thread for each lane, and finds what lanes do to each
other: ``NUMBA_DISABLE_JIT=1 python team_races.py STATE.npz LANES NUMBERS``, with numbers of the
source to replace, as JSON.

Between two barriers an element that one lane writes may not be read by another one, nor written by
another one unless both write the same without a look at it; what lanes exchange without memory is
no barrier. All lanes must come to the same barrier or exchange by the same calls. Prints, as JSON,
the number of barriers, what is wrong, and the barriers in the source that may be left out one by
one without a fault.
"""

import json
import sys
import threading
from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import numpy as np

from jaxgran.dynamics.numba_engine import layout
from jaxgran.dynamics.numba_engine.team import contacts, lanes, loop, memory

TEAM = (lanes, loop, contacts, memory)
Site = tuple[str, int]  # function and line of a barrier

lane_here = threading.local()
reads: dict[Any, set[int]] = defaultdict(set)
writes: dict[Any, dict[int, Any]] = defaultdict(dict)
sites: dict[int, list[Site]] = {}
barriers: list[Site] = []
wrong: set[str] = set()


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
    for module in TEAM:
        for name, other in others.items():
            setattr(module, name, other)


def watched(shape: Any, dtype: Any, name: str = "") -> Watched:
    array = np.zeros(shape, dtype)
    array.view(np.uint8)[...] = 0x7F  # not initialised
    return Watched(array, name)


def memory_of(count: int, count_of_lanes: int) -> Any:
    """The memory of a replica, with the names of its arrays."""
    replace(array_at=lambda address, shape, dtype: (watched(shape, dtype), address))
    made, _ = memory.memory_at(0, count, count_of_lanes)
    made.sums.name = "sums"
    for part in made[:-1]:
        for name, array in part._asdict().items():
            array.name = f"{type(part).__name__}.{name}"
    return made


def note(problem: str) -> None:
    """Note what is wrong, in the thread of one lane while all are at a barrier, and end the run."""
    wrong.add(problem)
    raise RuntimeError(problem)


def compare_sites() -> None:
    if len(set(map(tuple, sites.values()))) > 1:
        note(f"lanes wait at different places: {sites}")


def compare() -> None:
    compare_sites()
    barriers.append(sites[0][0])
    for element, by_lane in writes.items():
        readers = reads.get(element, set())
        several = len(by_lane) > 1
        differ = len({repr(x) for x in by_lane.values()}) > 1
        if differ or readers - set(by_lane) or (several and readers):
            note(f"{element[0]} is written and touched by others before {sites[0]}")
    reads.clear()
    writes.clear()


def advanced(given: Any, count_of_lanes: int, left_out: Site | None = None) -> np.ndarray:
    """Positions after a run without one of the barriers; what is wrong is noted."""
    for kept in (reads, writes, sites, barriers, wrong):
        kept.clear()
    meeting = threading.Barrier(count_of_lanes, action=compare)
    exchange = threading.Barrier(count_of_lanes, action=compare_sites)
    words: list[Any] = [None] * count_of_lanes

    def note_site() -> Site:
        frame, calls = sys._getframe(2), []
        while frame is not None and frame.f_code.co_name != "run":
            calls.append((frame.f_code.co_name, frame.f_lineno))
            frame = frame.f_back
        sites[lane_here.number] = calls
        return calls[0]

    def sync() -> None:
        if note_site() != left_out:
            meeting.wait(60)

    def words_of_all(word: Any) -> list[Any]:
        note_site()
        words[lane_here.number] = word
        exchange.wait(60)
        of_all = list(words)
        exchange.wait(60)
        return of_all

    def of_lane(team, number, lane):
        return words_of_all(number)[int(lane)]

    def ballot(team, agrees) -> np.uint64:
        return np.uint64(sum(bool(x) << n for n, x in enumerate(words_of_all(agrees))))

    replace(sync=sync, of_lane=of_lane, ballot=ballot)
    count, steps = len(given["radii"]), given["steps"]
    of_replica = memory_of(count, count_of_lanes)
    new = [watched((count, 2), float, name) for name in ("new positions", "new velocities")]
    results = watched((steps.size, layout.RESULTS), float, "results")

    def run(number: int) -> None:
        lane_here.number = number
        try:
            loop.advance_team(
                lanes.Team(np.uint64(number), np.uint64(count_of_lanes)),
                *(given[x] for x in ("positions", "velocities", "radii", "masses")),
                layout.Inputs(*given["inputs"]),
                steps,
                given["begin"],
                *new,
                results,
                of_replica,
            )
        except threading.BrokenBarrierError:
            pass
        except BaseException as problem:
            wrong.add(f"lane {number}: {problem!r}")
            meeting.abort()
            exchange.abort()

    threads = [threading.Thread(target=run, args=(n,)) for n in range(count_of_lanes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return new[0].array


def fill_the_room() -> list[int]:
    """More contacts are wanted than there is room for; no lane may write beyond it."""
    replace(sync=lambda: None, ballot=lambda team, agrees: np.uint64(agrees))
    written = np.zeros(3, np.int64)
    pairs = SimpleNamespace(calendar=np.array([[0] * 5, [0] * 5, [9] * 5]))
    network = SimpleNamespace(near_pair=written)
    alone = lanes.Team(np.uint64(0), np.uint64(1))
    found = loop._contacts_of_step(alone, 1, 5, pairs, network)
    return [found, *written.tolist()]


def add_terms(sums, first, terms) -> None:
    for n, term in enumerate(terms):
        sums[first + n] += term


def main(file: str, count_of_lanes: int, numbers: dict[str, int]) -> None:
    replace(bits_of=lambda word: int(word).bit_count(), _add_terms=add_terms)
    room = fill_the_room()
    replace(**numbers)
    given = dict(np.load(file))
    positions = advanced(given, count_of_lanes).tolist()
    found, places, needless = sorted(wrong), list(barriers), []
    for place in sorted(set(places)):
        advanced(given, count_of_lanes, left_out=place)
        if not wrong:
            needless.append(place)
    print(
        json.dumps(
            {
                "barriers": len(places),
                "places": sorted(set(places)),
                "wrong": found,
                "needless": needless,
                "positions": positions,
                "room": room,
            }
        )
    )


if __name__ == "__main__":
    np.seterr(all="ignore")
    main(sys.argv[1], int(sys.argv[2]), json.loads(sys.argv[3]))
