"""How well a restitution will be known from tracks, before anything is measured.

The flow is simulated at so fine a time step that collisions take place at their instants. Its frames are given the
noise of the experiment. Collisions are then sought and chosen as in ``fit_restitution``, at the true α. The information
of one collision is half the second derivative of its misfit by α, the least over its five unknowns: a Schur complement.
That of an experiment is the sum over its collisions, and one over its root is the smallest standard error that an
estimate without bias can have.

Information grows with grains and frames, apart from the first and last frames, where flights are cut off. So
64 grains in 50 frames suffice, as many times as 300 collisions need. Their scatter gives the error of the result.

Sources: C. R. Rao, Bull. Calcutta Math. Soc. 37, 81 (1945), on the bound; S. A. Murphy and A. W. van der Vaart, J. Am.
Stat. Assoc. 95, 449 (2000), on the information that other unknowns leave.
"""

from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import lax
from jaxtyping import Array

from jaxgran.contact.projected_methods import DEFAULT_SOLVER, ProjectedMethod
from jaxgran.dynamics.advance import advance
from jaxgran.dynamics.engine import Engine, Numerics, checked_numerics
from jaxgran.inference.collision_model import Collisions
from jaxgran.inference.collisions import LONGEST, Candidates, Flights, Noise, candidates, flights_of, relative_step
from jaxgran.inference.restitution import LEAST_NOISE, LONGEST_STEP
from jaxgran.inference.selection import FEWEST, largest_misfit, of_two_discs, struck_windows, without_repeats
from jaxgran.io.tracks import Tracks, tracks_of_states
from jaxgran.model.checks import InputError, require_key, require_number, require_untraced, require_whole, short_repr
from jaxgran.model.flow import ShearFlow, require_flow, require_sheared
from jaxgran.model.state import State
from jaxgran.model.status import MEANINGS, Status
from jaxgran.sampling.prediction import predicted
from jaxgran.sampling.steady_state import prepare

DEFAULT_COLLISIONS = 0.1  # of a disc from frame to frame, by Enskog's theory, where no time between them is given
DEFAULT_STEP = 0.2  # diameters by which a disc moves at most in that time
_GRAINS, _FRAMES = 64, 50  # of a simulated trajectory, at most
_FEWEST_TRAJECTORIES, _MOST_TRAJECTORIES = 6, 12
_ENOUGH = 300  # collisions; their information varies by about its mean, so it is then known to about a tenth
_FINE = 1e-6  # time step, in the time in which a disc moves by its diameter
_TOLERANCE = 1e-8
_MOST_FRAMES = 10**9
_HOPELESS = 2.0  # collisions of a disc from frame to frame, above which one in e⁴ is alone for both of its discs
_CHANGE = 0.05  # of ln(noise), for the derivative of the error by it


@dataclass(frozen=True)
class TrackNoise:
    """Errors of what is seen of discs, as standard deviations.

    ========  ====  =====================================================================================
    field     unit  meaning
    ========  ====  =====================================================================================
    position  σ     of a component of a position
    velocity  σ/t   of a component of a velocity; None where velocities are not seen
    diameter  σ     of the distance at contact, as in ``fit_restitution``: that of a diameter over √2
    ========  ====  =====================================================================================

    Raises:
      InputError: (a ValueError) a number is below zero or not finite.
    """

    position: float
    velocity: float | None = None
    diameter: float = 0.0

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None or field.name != "velocity":
                words = "a number of at least 0" + (" or None" if field.name == "velocity" else "")
                require_number(field.name, value, lambda x: (x >= 0) & np.isfinite(x), words)


@dataclass(frozen=True)
class FisherInformation:
    """What an experiment will say about the restitution.

    ==============  ====  =======================================================================================
    field           unit  meaning
    ==============  ====  =======================================================================================
    information     –     Fisher's information of α, 1/stderr²
    stderr          –     standard error of α to be expected, the bound of Cramér and Rao
    stderr_error    –     standard error of ``stderr``, from the simulated trajectories
    collisions      –     number of collisions of two discs to be used, in all frames
    usable          –     their share in all collisions; small where frames are too far apart, or discs stay in touch
    frame_strain    –     strain from frame to frame
    step            σ     how far neighbouring discs move apart between frames, the median
    position_share  –     what better positions would help: the relative change of ``stderr`` over that of this noise
    velocity_share  –     the same of the velocities; the three shares add up to one
    diameter_share  –     the same of the diameters
    ==============  ====  =======================================================================================
    """

    information: float
    stderr: float
    stderr_error: float
    collisions: float
    usable: float
    frame_strain: float
    step: float
    position_share: float
    velocity_share: float
    diameter_share: float


def fisher_information(
    flow: ShearFlow,
    frames: int,
    noise: TrackNoise,
    *,
    frame_strain: float | None = None,
    missing: float = 0.0,
    key: Array | None = None,
    solver: ProjectedMethod = DEFAULT_SOLVER,
    engine: Engine | None = None,
) -> FisherInformation:
    """How well ``fit_restitution`` will know the restitution of a flow from tracks that are yet to be measured.

    It prepares and shears a part of the flow: some seconds, more where collisions are rare or compiling is needed.

    Args:
      flow: the discs to be followed, all ``grains`` of them.
      frames: number of frames.
      noise: errors of what is seen. Below 1e-5 diameters, or 1e-5 of the speed, it counts as 1e-5.
      frame_strain: strain from frame to frame; None for a short one, in which kinetic theory expects 0.1
        collisions of a disc, and no step above 0.2 diameters.
      missing: probability with which a disc is not seen in a frame.
      key: JAX random key of the simulation and its noise; None for that of the seed 0.
      solver: solves the contacts; the trajectories have a tolerance of at most 1e-8.
      engine: as in ``sample``.

    Raises:
      InputError: (a ValueError) a number is outside its range, the flow is not sheared, or nothing will be learnt: the
        frames are too far apart, or too few collisions can be told from the noise. The message says what would help.
      RuntimeError: the flow does not become steady or cannot be simulated.
    """
    require_untraced(
        "fisher_information", "it searches in NumPy, so call it for each flow", flow, frame_strain, missing
    )
    require_flow(flow)
    require_sheared(flow)
    require_whole("frames", frames, 2, _MOST_FRAMES, "a bound of what is meaningful")
    if not isinstance(noise, TrackNoise):
        raise InputError(f"noise must be a TrackNoise, such as jg.TrackNoise(position=1e-3), not {short_repr(noise)}.")
    if frame_strain is not None:
        require_number("frame_strain", frame_strain, lambda x: (x > 0) & np.isfinite(x), "a positive number")
    require_number("missing", missing, lambda x: (x >= 0) & (x < 1), "at least 0 and below 1")
    key = jax.random.key(0) if key is None else key
    require_key(key)
    with jax.enable_x64(True):
        return _expected(
            _part(flow), checked_numerics(solver, engine), flow.grains, frames, noise, frame_strain, float(missing), key
        )


def _part(flow: ShearFlow) -> ShearFlow:
    """A flow of fewer grains, with numbers of double precision."""
    names = vars(flow).keys() - {"grains", "activation"}
    numbers = {name: np.asarray(getattr(flow, name)).item() for name in names}
    return replace(flow, **numbers, grains=min(flow.grains, _GRAINS))


class _Found(NamedTuple):
    """What one trajectory says.

    information: of each collision that is used, as measured, and with each of the three noises larger and smaller.
    window: of each, the frame before it. collisions: all of the flow. step: of neighbours between frames.
    """

    information: np.ndarray  # (1 + 6, collisions)
    window: np.ndarray
    collisions: float
    step: float


def _expected(
    flow: ShearFlow,
    numerics: Numerics,
    grains: int,
    frames: int,
    noise: TrackNoise,
    frame_strain: float | None,
    missing: float,
    key: Array,
) -> FisherInformation:
    theory = jax.tree.map(lambda x: float(x[0]), predicted(jax.tree.map(np.atleast_1d, flow)))
    rate, shear_rate = theory.collision_rate, float(flow.shear_rate)  # of a disc, in a unit of strain
    crossing = 1 / np.sqrt(2 * theory.granular_temperature)  # time in which a disc moves by its diameter
    short = float(min(DEFAULT_COLLISIONS / rate, DEFAULT_STEP * crossing * shear_rate))
    frame_strain = short if frame_strain is None else float(frame_strain)
    if frame_strain * rate > _HOPELESS:
        raise InputError(_too_long(frame_strain, f"a disc collides {frame_strain * rate:.2g} times", short))
    key, of_noise = jax.random.split(key)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(of_noise)).tolist())
    solver, engine = numerics.solver, numerics.engine
    state = prepare(flow, key, solver=solver, engine=engine)
    timestep = min(float(flow.timestep), _FINE * crossing)
    exact = replace(flow, timestep=timestep)
    tight = Numerics(replace(solver, tolerance=min(float(solver.tolerance), _TOLERANCE)), engine)
    steps = max(1, round(frame_strain / (shear_rate * timestep)))
    seen_frames, found, used = min(frames, _FRAMES), [], 0
    while len(found) < _FEWEST_TRAJECTORIES or (used < _ENOUGH and len(found) < _MOST_TRAJECTORIES):
        state, tracks, collisions = _tracks(exact, tight, state, steps, seen_frames)
        seen = _spoilt(tracks, noise, missing, rng)
        found.append(_found(seen, float(exact.restitution), noise, collisions, _step(tracks)))
        used += found[-1].information.shape[1]
    step = float(np.mean([part.step for part in found]))
    if not step <= LONGEST_STEP:
        raise InputError(_too_long(frame_strain, f"neighbouring discs move apart by {step:.2g} diameters", short))
    return _joined(found, frames, seen_frames, grains / flow.grains, frame_strain, step)


def _joined(
    found: list[_Found], frames: int, seen_frames: int, size: float, frame_strain: float, step: float
) -> FisherInformation:
    """The result for all frames and grains; ``size`` is the number of grains over those that were simulated."""
    first, last = LONGEST, seen_frames - 2 - LONGEST  # windows with flights of full length
    inside = max(last - first + 1, 0)

    def scaled(values: np.ndarray, window: np.ndarray) -> np.ndarray:
        """The sum over the collisions of a trajectory, and for each frame more that of a window inside."""
        more = values[..., (window >= first) & (window <= last)].sum(axis=-1) / max(inside, 1)
        return size * (values.sum(axis=-1) + (frames - seen_frames) * more)

    parts = np.array([scaled(part.information, part.window) for part in found])  # (trajectories, 7)
    collisions = float(np.mean([scaled(np.ones(len(part.window)), part.window) for part in found]))
    used = sum(len(part.window) for part in found) / max(sum(part.collisions for part in found), 1)
    information, *changed = parts.mean(axis=0)
    if collisions < FEWEST or not information > 0:
        raise InputError(_too_few(collisions, used))
    error = parts[:, 0].std(ddof=1) / np.sqrt(len(parts)) / information
    larger, smaller = np.array(changed).reshape(2, 3)
    position, velocity, diameter = np.log(smaller / larger) / (4 * _CHANGE)
    stderr = float(1 / np.sqrt(information))
    return FisherInformation(
        information=float(information),
        stderr=stderr,
        stderr_error=float(stderr * error / 2),
        collisions=collisions,
        usable=min(float(used), 1.0),
        frame_strain=float(frame_strain),
        step=step,
        position_share=float(position),
        velocity_share=float(velocity),
        diameter_share=float(diameter),
    )


def _too_long(frame_strain: float, meaning: str, short: float) -> str:
    """What would help where frames are too far apart."""
    return (
        f"nothing will be learnt at a frame_strain of {frame_strain:.2g}, in which {meaning}: take about {short:.1g}."
    )


def _too_few(collisions: float, usable: float) -> str:
    """What would help where too few collisions are to be expected."""
    found = f"nothing will be learnt from {collisions:.2g} collisions, as a fit needs {FEWEST}"
    if usable < 0.1:
        share = f"{100 * usable:.2g} % of all can be told from the noise"
        return f"{found}: {share}, so take a shorter frame_strain, more frames, or less noise."
    return f"{found}: take more frames, or follow more discs."


def _tracks(flow: ShearFlow, numerics: Numerics, state: State, steps: int, frames: int) -> tuple[State, Tracks, float]:
    """The state after some frames, their tracks without noise, and the number of collisions between them."""
    state, (states, collisions, status) = _frames(flow, numerics, state, np.int32(steps), frames)
    worst = Status(int(np.max(status)))
    if worst >= Status.infeasible:
        raise RuntimeError(f"the flow could not be simulated: {MEANINGS[worst.name]}.")
    strain = steps * float(flow.timestep) * float(flow.shear_rate) * np.arange(frames)
    return state, tracks_of_states(strain, states, float(flow.shear_rate)), float(np.sum(collisions[:-1]))


@partial(jax.jit, static_argnames="frames")
def _frames(flow: ShearFlow, numerics: Numerics, state: State, steps: Array, frames: int) -> Any:
    def next_frame(state: State, _: None) -> tuple[State, tuple]:
        after, tally = advance(flow, state, steps, solver=numerics.solver, engine=numerics.engine)
        return after, (state, tally.collisions, tally.status)

    return lax.scan(next_frame, state, length=frames)


def _spoilt(tracks: Tracks, noise: TrackNoise, missing: float, rng: np.random.Generator) -> Tracks:
    """The tracks as they will be seen."""
    shape = tracks.positions.shape
    positions = tracks.positions + noise.position * rng.normal(size=shape)
    off = np.nan if noise.velocity is None else noise.velocity
    velocities = tracks.velocities + off * rng.normal(size=shape)
    unseen = rng.random(shape[:2]) < missing
    positions[unseen], velocities[unseen] = np.nan, np.nan
    diameters = tracks.diameters + np.sqrt(2) * noise.diameter * rng.normal(size=shape[1])
    return replace(tracks, positions=positions, velocities=velocities, diameters=diameters)


def _found(tracks: Tracks, restitution: float, noise: TrackNoise, collisions: float, step: float) -> _Found:
    """The information of the collisions that a fit would use, found in two searches as there."""
    flights, length, duration = flights_of(tracks)
    velocity = np.inf if noise.velocity is None else noise.velocity * duration / length
    of_fit = Noise(*(max(x, LEAST_NOISE) for x in (noise.position / length, velocity, noise.diameter / length)))
    first = _used(flights, of_fit, restitution, None)
    second = None if first is None else _used(flights, of_fit, restitution, first.struck)
    if second is None or not len(second.seen.window):
        return _Found(np.zeros((7, 0)), np.zeros(0, int), collisions, step)
    factors = np.exp(_CHANGE * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]))
    information = [
        Collisions(second.seen, Noise(*(x * np.array(of_fit)))).fitted(restitution, second.unknowns).curvature
        for x in factors
    ]
    return _Found(np.array(information), second.seen.window, collisions, step)


def _step(tracks: Tracks) -> float:
    flights, length, _ = flights_of(tracks)
    return relative_step(flights) * length


class _Used(NamedTuple):
    seen: Candidates
    unknowns: np.ndarray
    struck: np.ndarray


def _used(flights: Flights, noise: Noise, restitution: float, struck: np.ndarray | None) -> _Used | None:
    """The collisions that a fit would use if it knew the restitution; None where there are no candidates."""
    seen = candidates(flights, noise, struck)
    if seen is None:
        return None
    collisions = Collisions(seen, noise)
    fitted = collisions.fitted(restitution)
    likely = of_two_discs(collisions, fitted) & (fitted.misfit < largest_misfit(collisions))
    used = without_repeats(collisions, fitted, likely)
    struck = struck_windows(collisions, fitted, used, *flights.positions.shape[:2])
    return _Used(Candidates(*(x[used] for x in seen)), fitted.unknowns[used], struck)
