"""Whether momentum or relaxation tuned by gradient solves contact networks in fewer products with W than the default.

The tuned method is a projected one of ``jaxgran.contact.projected_methods`` with three numbers, 0 < τ < 2, 0 ≤ s ≤ 1
and r > 0,

    p ← max(0, y − τ D⁻¹(W y + b)),    y = p + s k/(k + r) (p − p_before),    W ⪯ D the spectral bound.

Nesterov's method is τ = s = 1, r = 3; the Jacobi method is s = 0 with the relaxation τ = 1.8. Adam lowers the mean over
training networks of log₁₀ of the relative residual after K iterations, differentiated through all of them; a residual
counts down to 1e-8. A restart has no derivative: training has none, the evaluation is with and without.

Half of each group of ``networks.collection`` is for training: the earlier half of a flow, half of the seeds, every
other size of chains and clusters. The rest is held out; size and mass ratio groups change only their velocities there.
Networks without a solution are left out. The verdict is about the tuned method that is best on the training networks.

    python -m benchmarks tune_solver            # about 2 minutes on one core
    python -m benchmarks tune_solver --quick    # smaller collection, one K, few optimiser steps; under a minute
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from matplotlib.figure import Figure

import jaxgran as jg
from benchmarks.networks import GRAINS, INFEASIBLE, Network, collection
from benchmarks.output import Output
from jaxgran.contact.delassus import delassus_product, diagonal, spectral_bound
from jaxgran.contact.network import Contacts
from jaxgran.contact.solver import solve
from jaxgran.model.status import Status

DEFAULT, TOLERANCES, FLOOR, RATE = "barzilai-borwein", (1e-4, 1e-6), 1e-8, 0.05
STOCK = {"momentum": (1.0, 1.0, 3.0), "relaxation": (1.8, 0.0, 1.0)}  # τ, s, r
_FIRST = {"momentum": (0.0, 4.6, 2.95), "relaxation": (2.2,)}  # free parameters; s = 0.99, as 1 is out of their reach
_ALIKE = {"chains": 1, "hexagonal cluster": 2}  # so many neighbours in these groups are of one size
_LOOKS, _LINES = {"momentum": ("black", "o"), "relaxation": ("tab:red", "s")}, {40: "-", 120: "--", 400: ":"}


def run(output: Output) -> None:
    """Tune, compare on held-out networks, print the verdict, and write JSON and PNG."""
    cap, steps, depths = (2000, 40, (40,)) if output.quick else (5000, 300, (40, 120, 400))
    groups = {group: members for group, members in collection(output.quick).items() if group != INFEASIBLE}
    places = [(group, k) for group, members in groups.items() for k in range(len(members))]
    networks, names = [groups[group][k] for group, k in places], np.array([group for group, _ in places])
    out = [k // _ALIKE[g] % 2 == 1 if g in _ALIKE else k >= len(groups[g]) // 2 for g, k in places]
    train = [network for network, kept in zip(networks, out, strict=True) if not kept]
    tunings = [tuned(kind, train, depth, steps) for kind in STOCK for depth in depths]
    products = {name: measured(networks, method, cap) for name, method in contestants(tunings).items()}
    print(f"{sum(out)} held-out networks, to {TOLERANCES}: median and 90th percentile of products, share converged")
    spreads = {}
    for name, costs in ((name, costs[out]) for name, costs in products.items()):  # a failure is infinitely dear
        spreads[name] = np.stack([*np.percentile(costs, (50, 90), 0, method="higher"), np.isfinite(costs).mean(0)])
        print(f"{name:40s}", *(f"{np.array2string(x, precision=3):>16s}" for x in spreads[name]))
    print(sentence := verdict(products, names, np.array(out), cap))
    head = {"hardware": output.hardware | {"optax": optax.__version__}, "cap": cap, "tolerances": TOLERANCES}
    head |= {"verdict": sentence, "tunings": tunings, "trained on": len(train), "held out": sum(out)}
    # JSON has no infinity.
    costs, shown = jax.tree.map(lambda x: np.where(np.isfinite(x), x, None).tolist(), (products, spreads))
    head["held-out median, 90th percentile, share converged"] = shown
    solves = [{name: costs[name][place] for name in products} for place in range(len(networks))]
    rows = [{"group": str(g), "held out": o} | each for g, o, each in zip(names, out, solves, strict=True)]
    output.write_rows("tune_solver", head, "products", rows)
    output.write_picture(draw(tunings, spreads), "tune_solver")


def merged(networks: list[Network]) -> tuple[Contacts, np.ndarray]:
    """All networks as one of disjoint parts, without unused slots, and the network of each contact."""
    parts = [jax.tree.map(lambda x, used=n.contacts.used: x[used], n.contacts) for n in networks]
    parts = [replace(part, i=part.i + GRAINS * k, j=part.j + GRAINS * k) for k, part in enumerate(parts)]
    owner = np.repeat(np.arange(len(parts)), [part.i.size for part in parts])
    return jax.tree.map(lambda *fields: jnp.concatenate(fields), *parts), owner


def bounded(free: jax.Array) -> jax.Array:
    """τ, s, r of three free parameters, or of one the relaxation without momentum."""
    momentum = (jax.nn.sigmoid(free[1]), jax.nn.softplus(free[2])) if free.size == 3 else (0.0, 1.0)
    return jnp.stack([2 * jax.nn.sigmoid(free[0]), *momentum])


@partial(jax.jit, static_argnames=("networks", "iterations"))
def loss(at: jax.Array, contacts: Contacts, owner: jax.Array, networks: int, iterations: int) -> jax.Array:
    """Mean over the networks of log₁₀ of the relative residual after the iterations, without a restart."""
    (tau, share, delay), grains, b = at, GRAINS * networks, contacts.approach
    own, bound = diagonal(contacts, grains), spectral_bound(contacts, grains)

    def iterate(points: tuple[jax.Array, ...], k: jax.Array) -> tuple[tuple[jax.Array, ...], None]:
        point, previous = points
        start = point + share * k / (k + delay) * (point - previous)
        return (jnp.maximum(0, start - tau * (delassus_product(contacts, start, grains) + b) / bound), point), None

    (point, _), _ = jax.lax.scan(iterate, (jnp.zeros_like(b),) * 2, jnp.arange(iterations, dtype=b.dtype))
    error = jnp.minimum(own * point, delassus_product(contacts, point, grains) + b)
    squared, scale = (jax.ops.segment_sum(x**2, owner, networks) for x in (error, jnp.minimum(b, 0)))
    return jnp.mean(jnp.log10(squared / scale + FLOOR**2)) / 2


def tuned(kind: str, networks: list[Network], iterations: int, steps: int) -> dict[str, Any]:
    """The numbers of the smallest training loss that Adam meets, from those of the stock method; and all losses."""
    (contacts, owner), optimiser, free = merged(networks), optax.adam(RATE), jnp.array(_FIRST[kind])
    objective = partial(loss, contacts=contacts, owner=owner, networks=len(networks), iterations=iterations)
    slope = jax.jit(jax.value_and_grad(lambda free: objective(bounded(free))))
    state, history, stock = optimiser.init(free), [], float(objective(jnp.array(STOCK[kind])))
    for _ in range(steps):
        value, gradient = slope(free)
        history.append((float(value), bounded(free).tolist()))
        update, state = optimiser.update(gradient, state)
        free = jnp.asarray(optax.apply_updates(free, update))
    losses, (least, after) = [value for value, _ in history], min(history)
    print(f"{kind}, K = {iterations}: {np.round(after, 3)}, loss {stock:.3f} → {least:.3f}", flush=True)
    before = {"before": STOCK[kind], "loss_before": stock}
    return {"kind": kind, "K": iterations, "after": after, "losses": losses, **before}


def contestants(tunings: list[dict[str, Any]]) -> dict[str, jg.ProjectedMethod]:
    """All methods that are compared."""
    rules: dict[str, jg.ProjectedMethod] = {
        "jacobi": jg.Jacobi(),
        "nesterov": jg.Nesterov(),
        DEFAULT: jg.BarzilaiBorwein(),
        "nesterov, no restart": Momentum(numbers=jnp.array(STOCK["momentum"])),
    }
    both = {", no restart": Momentum, ", restart": Restarted}
    for t in tunings:
        for ending, method in (both if t["kind"] == "momentum" else {"": Momentum}).items():
            rules[f"tuned {t['kind']}, K = {t['K']}{ending}"] = method(numbers=jnp.array(t["after"]))
    return rules


@dataclass(frozen=True)
class Momentum(jg.ProjectedMethod):
    """A step of length τ from p + s k/(k + r) (p − p_before)."""

    numbers: Any = None  # τ, s, r

    def init(self, approach: jax.Array) -> Any:
        return 0.0

    def propose(self, now: Any) -> tuple[jax.Array, jax.Array]:
        k, (tau, share, delay) = now.memory, self.numbers
        return now.point + share * k / (k + delay) * (now.point - now.previous), tau

    def learn(self, now: Any, *_: Any) -> Any:
        return now.memory + 1


@dataclass(frozen=True)
class Restarted(Momentum):
    """The same with Nesterov's restarts."""

    learn = jg.Nesterov.learn


def measured(networks: list[Network], method: jg.ProjectedMethod, cap: int) -> np.ndarray:
    """Products with W until each residual is reached, (networks, tolerances); infinite if it is not within the cap."""
    once = jax.jit(lambda contacts, solver: solve(contacts, GRAINS, 1.0, solver, jnp.asarray(True)))
    solvers = [replace(method, tolerance=tolerance, max_steps=cap) for tolerance in TOLERANCES]
    tried = [[once(network.contacts, solver) for solver in solvers] for network in networks]
    return np.array([[float(x.iterations) if x.status == Status.ok else np.inf for x in pair] for pair in tried])


def verdict(products: dict[str, np.ndarray], group: np.ndarray, out: np.ndarray, cap: int) -> str:
    """How the tuned method that is best in training compares with the default on held-out networks."""

    def logs(name: str, chosen: np.ndarray) -> np.ndarray:
        """Ratio of products by group, in which a failure counts as twice the cap."""
        each = np.log(np.minimum(products[name], 2 * cap) / np.minimum(products[DEFAULT], 2 * cap))
        return np.array([each[(group == one) & chosen].mean(0) for one in np.unique(group)])

    best = min((name for name in products if name.startswith("tuned")), key=lambda name: logs(name, ~out).mean())
    mean, error = logs(best, out).mean(0), logs(best, out).std(0, ddof=1) / np.sqrt(len(np.unique(group)))
    signs = np.where(np.abs(mean) < 2 * error, 0, np.sign(mean)).sum()
    answer = {-2: "beats", 2: "loses to"}.get(int(signs), "is not clearly different at both tolerances from")
    fewer, failed = (products[best] < products[DEFAULT])[out].sum(0), np.isinf(products[best])[out].sum(0)
    middle = np.median((products[best] / np.minimum(products[DEFAULT], 2 * cap))[out], axis=0)
    words = "; ".join(
        f"{np.exp(m):.2f} (×/÷ {np.exp(e):.2f}; median {h:.2f}) to {t:.0e}, fewer on {n} and beyond the cap on {f}"
        for t, m, e, h, n, f in zip(TOLERANCES, mean, error, middle, fewer, failed, strict=True)
    )
    return f"{best}: {answer} the default, {DEFAULT}; on {out.sum()} held-out networks products over its: {words}."


def draw(tunings: list[dict[str, Any]], spreads: dict[str, np.ndarray]) -> Figure:
    """Training loss against optimiser step, and products needed on held-out networks by method."""
    figure = Figure(figsize=(13, 5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.2))
    for t in tunings:
        colour, marker = _LOOKS[t["kind"]]
        left.plot(t["losses"], _LINES[t["K"]], color=colour, label=f"{t['kind']}, K = {t['K']}")
        left.plot(0, t["loss_before"], marker, color=colour, markerfacecolor="none")
    left.set(xlabel="step of the optimiser", ylabel="mean log₁₀ of the relative residual after K iterations")
    left.set(title="training; open symbols: stock numbers", ylim=(None, -0.8))
    left.legend(fontsize="small", ncols=2, loc="upper right")
    table = np.array(list(spreads.values()))  # (methods, 3, tolerances)
    edge = 1.5 * np.max(table[:, :2], initial=1, where=np.isfinite(table[:, :2]))
    for k, (tolerance, marker, face) in enumerate(zip(TOLERANCES, "os", ("white", "0.25"), strict=True)):
        y, (median, end) = np.arange(len(table)) + 0.34 * k - 0.17, np.minimum(table[:, :2, k].T, edge)
        right.hlines(y, median, end, color="0.5", lw=1)
        right.plot(median, y, marker, color="black", markerfacecolor=face, label=f"to {tolerance:.0e}")
        right.plot(end[end < edge], y[end < edge], "k|")
        right.plot(end[end == edge], y[end == edge], "k>")
    words = [f"{n}{' (default)' * (n == DEFAULT)}  {x[2, 0]:.0%} / {x[2, 1]:.0%}" for n, x in spreads.items()]
    right.set(xscale="log", ylim=(len(table) - 0.4, -0.6), xlabel="products with W: median to 90th percentile")
    right.set(title="held out, with shares that converged; ▸: not within the cap")
    right.set_yticks(range(len(words)), words, fontsize="small")
    right.grid(alpha=0.3, axis="x")
    right.legend(fontsize="small", loc="lower left")
    return figure
