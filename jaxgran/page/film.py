"""A flow as a page that plays: its grains and forces frame by frame, and the averages up to each frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array

from jaxgran.analysis.instant import Instant, instant_of
from jaxgran.dynamics.engine import Numerics
from jaxgran.dynamics.snapshots import Snapshot
from jaxgran.dynamics.tally import Tally
from jaxgran.model.display import unit_text
from jaxgran.model.flow import ShearFlow
from jaxgran.model.state import State
from jaxgran.page.document import Page, document
from jaxgran.page.grain_data import ENCODING, grain_data, scale_of
from jaxgran.page.map_data import numbers
from jaxgran.plotting.movie import Frames
from jaxgran.sampling.averages import averages
from jaxgran.sampling.batch import AdvanceBatch, AdvanceWrapper
from jaxgran.sampling.observables import OBSERVABLES
from jaxgran.sampling.recorder import Recorder

AVERAGES = ("force_ratio", "pressure", "shear_stress", "granular_temperature")
"""Averages whose course a page shows."""

_MOST_DRAWN_GRAINS = 300_000  # of all frames together, about 3 MB
_SCRIPTS = ("page.js", "grains.js", "flow.js")


class _Seen(NamedTuple):
    """A frame: the grains, and the averages from the first frame to this one; NaN in the first."""

    instant: Instant
    averages: dict[str, float]


class Film:
    """Keeps the frames of a flow and its running averages, while a ``Recorder`` calls ``frames.keep`` with each."""

    def __init__(self):
        self._sum: Tally | None = None
        self._area = np.zeros(1)
        self.flow: ShearFlow | None = None
        self.frames = Frames(self._seen)

    def recording(self, recorder: Recorder) -> AdvanceWrapper:
        """A wrapper that records frames with the recorder, and keeps the sums of the time steps up to each frame."""
        return lambda advance: recorder.recording(self._summed(advance))

    def _summed(self, advance: AdvanceBatch) -> AdvanceBatch:
        self._sum = None

        def advance_and_sum(flow: ShearFlow, numerics: Numerics, state: State, steps: Array) -> tuple[State, Tally]:
            state, tally = advance(flow, numerics, state, steps)
            self._sum = tally if self._sum is None else self._sum + tally
            self.flow, self._area = flow, np.asarray(state.side) ** 2
            return state, tally

        return advance_and_sum

    def _seen(self, frame: Snapshot) -> _Seen:
        if self._sum is None or self.flow is None:
            return _Seen(instant_of(frame), dict.fromkeys(AVERAGES, np.nan))
        found = averages(self._sum, self._area, self.flow.grains, np.asarray(self.flow.shear_rate))
        return _Seen(instant_of(frame), {name: np.asarray(found[name]).item() for name in AVERAGES})

    def page(self) -> Page:
        """The page of the frames so far, or of every second of them and so on. All have one scale."""
        assert self.flow is not None
        every = -(-len(self.frames.scenes) * self.flow.grains // _MOST_DRAWN_GRAINS)
        seen, strains = self.frames.scenes[::every], self.frames.strains[::every]
        scale = scale_of(*(np.concatenate([getattr(one.instant, name) for one in seen]) for name in ("speed", "force")))
        alpha, nu, dt = (
            np.asarray(x).item() for x in (self.flow.restitution, self.flow.packing_fraction, self.flow.timestep)
        )
        rule = "midpoint" if np.asarray(self.flow.activation_fraction).item() > 0 else "touching"
        window, one_step = seen[0].instant.window, dt * np.asarray(self.flow.shear_rate).item()
        forces = f"mean forces over a strain of {window:.3g}" if window > 1.5 * one_step else "forces of one time step"
        data = {
            "title": f"Sheared flow at α = {alpha:g}, ν = {nu:g}",
            "about": f"N = {self.flow.grains}, dt = {dt:g}/γ̇, {rule} activation. "
            f"A frame shows the {forces}. Averages are those from the first frame to the one shown.",
            "strain": strains,
            "frames": [grain_data(**one.instant._asdict(), scale=scale) for one in seen],
            "averages": [
                {
                    "name": name.replace("_", " "),
                    "unit": unit_text(OBSERVABLES[name].unit),
                    "values": numbers(np.array([one.averages[name] for one in seen])),
                }
                for name in AVERAGES
            ],
            "encoding": ENCODING,
        }
        return document("flow", _SCRIPTS, data["title"], data)
