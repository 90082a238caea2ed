"""What derivatives of a flow cost, and how fast they grow with strain.

    python -m benchmarks gradients           # both parts
    python -m benchmarks gradients --quick   # one flow, fewer runs

The first part times an advance of 100 steps and its derivatives, on one core, and counts the memory
of the gradient of 1000 steps. The second follows ∂(state)/∂α with and without contacts that move in
time, beside the difference of two neighbouring runs, and fits the exponent of its growth.
"""

import time
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.output import Output
from jaxgran.model.cell import displacement
from jaxgran.plotting.style import TWO_COLUMNS, styled

FLOWS = ((0.9, 0.6), (0.5, 0.6), (0.7, 0.75), (0.3, 0.75))  # restitution, packing fraction
DRAWN = (0.9, 0.6), (0.3, 0.75)
GRAINS, TIMESTEP, STRAIN, POINTS, RUNS = 64, 1e-6, 1.2, 48, 6
DIFFERENCE = 1e-4  # between the restitutions of two neighbouring runs
HORIZON = 100.0  # |∂(state)/∂α| at which a change of α by 0.01 moves the grains by a diameter
SOLVER = jg.BarzilaiBorwein(tolerance=1e-9, max_steps=20_000)
STEPS, MANY_STEPS, REPEATS = 100, 1000, 15
COSTS = (
    (64, 0.6, 0.7),
    (256, 0.6, 0.7),
    (64, 0.3, 0.75),
)  # grains, restitution, packing fraction; dt = 1e-3


def prepared(grains: int, alpha: float, nu: float, timestep: float, seed: int = 0):
    """A flow for derivatives and a state of it."""
    state = jg.prepare(jg.ShearFlow(grains, alpha, nu, 1e-3), jax.random.key(seed), 2.0)
    return jg.ShearFlow(grains, alpha, nu, timestep), state


def cost(grains: int, alpha: float, nu: float) -> dict:
    """Median seconds of an advance and of its derivatives in turn, and bytes of the gradient of a
    long one.
    """
    flow, state = prepared(grains, alpha, nu, 1e-3)
    events = int(jax.jit(partial(jg.count_events, solver=SOLVER))(flow, state, jnp.int32(STEPS)))

    def energy(restitution, velocities, number: int | None, steps: int = STEPS):
        start = replace(state, velocities=velocities)
        changed = replace(flow, restitution=restitution)
        engine = None if number is None else jg.Jax(events=number)
        end, _ = jg.advance(changed, start, jnp.int32(steps), solver=SOLVER, engine=engine)
        return jnp.sum(end.velocities**2)

    at = (jnp.asarray(alpha), state.velocities)
    tangents = (jnp.ones(()), jnp.zeros_like(state.velocities))
    gradient = jax.value_and_grad(energy, argnums=(0, 1))
    routes = {
        "advance": jax.jit(lambda *x: energy(*x, None)),
        "advance of fixed length": jax.jit(lambda *x: energy(*x, events)),
        "tangent": jax.jit(lambda *x: jax.jvp(lambda *y: energy(*y, None), x, tangents)),
        "gradient": jax.jit(lambda *x: gradient(*x, events)),
    }
    compile_seconds = {name: elapsed(route, *at) for name, route in routes.items()}
    times = {name: [] for name in routes}
    for _ in range(REPEATS):
        for name, route in routes.items():
            times[name].append(elapsed(route, *at))
    long = (
        jax.jit(lambda *x: gradient(*x, MANY_STEPS + 1, MANY_STEPS))
        .lower(*at)
        .compile()
        .memory_analysis()
    )
    return {
        "grains": grains,
        "restitution": alpha,
        "packing_fraction": nu,
        "steps": STEPS,
        "events": events,
        "median_seconds": {name: float(np.median(values)) for name, values in times.items()},
        "first_call_seconds": compile_seconds,
        "gradient_of_1000_steps_bytes": long.temp_size_in_bytes,
    }


def elapsed(function, *arguments) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - start


def followed(alpha: float, nu: float, runs: int) -> dict:
    """Growth of the derivatives of a flow and of the difference of two runs, (runs, points)
    each.
    """
    rows = {"moving": [], "fixed": [], "difference": []}
    for seed in range(runs):
        flow, state = prepared(GRAINS, alpha, nu, TIMESTEP, seed)
        for name, moving in (("moving", True), ("fixed", False)):
            rows[name].append(np.asarray(growth(flow, state, moving)).tolist())
        rows["difference"].append(np.asarray(differences(flow, state)).tolist())
    strain = STRAIN / POINTS * np.arange(1, POINTS + 1)
    exponents = {
        name: exponent(strain, np.array(values))
        for name, values in rows.items()
        if name != "difference"
    }
    typical = np.exp(np.mean(np.log(rows["moving"]), axis=0))
    beyond = np.flatnonzero(typical > HORIZON)
    return {
        "restitution": alpha,
        "packing_fraction": nu,
        "strain": strain.tolist(),
        "exponents": exponents,
        "horizon_strain": float(strain[beyond[0]]) if beyond.size else None,
        **rows,
    }


def exponent(strain: np.ndarray, derivative: np.ndarray) -> list[float]:
    """The rate λ of |∂(state)/∂α| ∝ exp(λ γ) and its standard error over runs; none of a single
    run.

    The rate of a run is the slope over the last three quarters of its strain, since the derivative
    starts from zero.
    """
    later = strain >= strain[-1] / 4
    slopes = np.polyfit(strain[later], np.log(derivative[:, later]).T, 1)[0]
    return [slopes.mean(), slopes.std(ddof=1) / np.sqrt(len(slopes))] if len(slopes) > 1 else []


@partial(jax.jit, static_argnames="moving_contacts")
def growth(flow, state, moving_contacts: bool):
    """Root mean square over the grains of |∂(position, velocity)/∂α|, at the points of the
    growth.
    """
    steps = jnp.int32(round(STRAIN / POINTS / TIMESTEP))

    def part(carry, _):
        def end(alpha, positions, velocities, tilt):
            start = replace(carry[0], positions=positions, velocities=velocities, tilt=tilt)
            changed = replace(flow, restitution=alpha)
            engine = jg.Jax(moving_contacts=moving_contacts)
            later, _ = jg.advance(changed, start, steps, solver=SOLVER, engine=engine)
            return later.positions, later.velocities, later.tilt

        now, change = carry
        at = (jnp.asarray(flow.restitution), now.positions, now.velocities, now.tilt)
        (x, c, tilt), change = jax.jvp(end, at, (jnp.ones_like(at[0]), *change))
        size = jnp.sqrt(jnp.mean(jnp.sum(change[0] ** 2 + change[1] ** 2, axis=-1)))
        return (replace(now, positions=x, velocities=c, tilt=tilt), change), size

    still = tuple(jnp.zeros_like(x) for x in (state.positions, state.velocities, state.tilt))
    return jax.lax.scan(part, (state, still), length=POINTS)[1]


@jax.jit
def differences(flow, state):
    """Distance of two runs whose restitutions differ, over the difference, at the points of the
    growth.
    """
    steps = jnp.int32(round(STRAIN / POINTS / TIMESTEP))

    def part(states, _):
        pair = [
            jg.advance(
                replace(flow, restitution=flow.restitution + sign * DIFFERENCE / 2),
                each,
                steps,
                solver=SOLVER,
            )[0]
            for sign, each in zip((1, -1), states, strict=True)
        ]
        moved = displacement(pair[0].positions, pair[1].positions, pair[0].side, pair[0].tilt)
        squares = jnp.sum(moved**2 + (pair[0].velocities - pair[1].velocities) ** 2, axis=-1)
        return tuple(pair), jnp.sqrt(jnp.mean(squares)) / DIFFERENCE

    return jax.lax.scan(part, (state, state), length=POINTS)[1]


@styled
def draw(flows: list[dict]) -> Figure:
    """Growth in the flows that are drawn: geometric means over the runs, with the scatter of one as
    a band.
    """
    figure = Figure(figsize=(TWO_COLUMNS, 2.4), layout="constrained")
    drawn = [flow for flow in flows if (flow["restitution"], flow["packing_fraction"]) in DRAWN]
    for axes, flow in zip(
        figure.subplots(1, len(drawn), sharey=True, squeeze=False)[0], drawn, strict=True
    ):
        strain = np.array(flow["strain"])
        logs = {name: np.log(np.array(flow[name])) for name in ("moving", "fixed", "difference")}
        middle, spread = logs["moving"].mean(0), logs["moving"].std(0)
        axes.fill_between(
            strain, np.exp(middle - spread), np.exp(middle + spread), color="0.87", lw=0
        )
        axes.plot(
            strain, np.exp(middle), "-", color="black", label="derivative, contacts move in time"
        )
        axes.plot(
            strain,
            np.exp(logs["fixed"].mean(0)),
            "--",
            color="0.4",
            label="derivative at fixed steps",
        )
        exponent = f"10^{{{round(np.log10(DIFFERENCE))}}}"
        label = rf"two runs, $\delta\alpha={exponent}$"
        axes.plot(
            strain[::3],
            np.exp(logs["difference"].mean(0))[::3],
            "o",
            mfc="none",
            color="black",
            label=label,
        )
        axes.axhline(HORIZON, color="0.6", lw=0.8, ls=":")
        axes.set_title(rf"$\alpha={flow['restitution']:g}$, $\nu={flow['packing_fraction']:g}$")
        axes.set(yscale="log", xlabel=r"strain $\dot\gamma t$", xlim=(0, strain[-1]))
    figure.axes[0].set_ylabel(
        r"$|\partial(\mathrm{state})/\partial\alpha|$ of a grain ($\sigma$, $\sigma\dot\gamma$)"
    )
    figure.axes[0].legend(loc="upper left")
    return figure


def run(output: Output) -> None:
    """Time the derivatives, follow their growth, print, and write JSON and PNG."""
    flows, runs, costs = (FLOWS[:1], 2, COSTS[:1]) if output.quick else (FLOWS, RUNS, COSTS)
    result = {"costs": [], "flows": []}
    for grains, alpha, nu in costs:
        result["costs"].append(cost(grains, alpha, nu))
        row = result["costs"][-1]
        print(
            {name: f"{1e3 * value:.2f} ms" for name, value in row["median_seconds"].items()},
            flush=True,
        )
        print(
            f"gradient of {MANY_STEPS} steps: "
            f"{row['gradient_of_1000_steps_bytes'] / 2**20:.0f} MiB",
            flush=True,
        )
    for alpha, nu in flows:
        result["flows"].append(followed(alpha, nu, runs))
        row = result["flows"][-1]
        print(
            f"({alpha}, {nu}): exponents {row['exponents']}, horizon {row['horizon_strain']}",
            flush=True,
        )
    output.write_json("gradients", result)
    output.write_picture(draw(result["flows"]), "gradients")
