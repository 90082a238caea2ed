"""jaxgran: flows of rigid, frictionless discs in simple shear by contact dynamics, in JAX.

    import jaxgran as jg
    flow = jg.ShearFlow(grains=256, restitution=0.5, packing_fraction=0.76, timestep=1e-4)
    state = jg.prepare(flow, jax.random.key(0))          # packed, heated, sheared to its steady state
    state, sample = jg.sample(flow, state, strain=5.0)
    sample.force_ratio, sample.errors()["force_ratio"]

Axis contract: grains carry ``(grains, 2)``, near pairs ``(pairs,)``, contacts ``(contacts,)``. Every function of the
engine is written for one replica; a batch adds a leading ``(replicas,)`` axis through ``jax.vmap`` with
``axis_name="replica"`` or through ``jax.lax.map``. Units: mean grain diameter σ, mass m of a grain of that diameter,
shear rate γ̇.

Importing this package imports nothing heavy and changes no flag of JAX; names are loaded when they are first used.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxgran.calibrate import RestitutionFit, fit_restitution
    from jaxgran.closure import Closure, predict
    from jaxgran.closure_fit import fit_closure
    from jaxgran.coarse_graining import gaussian, heaviside, lucy
    from jaxgran.dynamics import State, count_events
    from jaxgran.fields import Fields, fields_at
    from jaxgran.figures import ratio_against_timestep, ratio_contours, ratio_curves, save_figures
    from jaxgran.flow import ShearFlow
    from jaxgran.flow_figures import flow_figure
    from jaxgran.free_cooling import Cooling, cooling
    from jaxgran.grains import Grains, own_grains, polydisperse
    from jaxgran.measure import Sample, sample
    from jaxgran.native import advance
    from jaxgran.packing import pack
    from jaxgran.protocol import heated, prepare
    from jaxgran.rheology import friction_law
    from jaxgran.rheology_figures import friction_figure
    from jaxgran.snapshots import Snapshot, snapshot_series
    from jaxgran.status import Status
    from jaxgran.stress_inversion import restitution_from_stresses
    from jaxgran.sweep import ratio_map
    from jaxgran.tally import Tally
    from jaxgran.theory_figures import cluster_shares, theory_errors
    from jaxgran.trajectory import Trajectory, read_trajectory

__version__ = version("jaxgran")

_HOME = {
    "ShearFlow": "flow",
    "Grains": "grains",
    "polydisperse": "grains",
    "own_grains": "grains",
    "State": "dynamics",
    "advance": "native",
    "pack": "packing",
    "Tally": "tally",
    "Status": "status",
    "Sample": "measure",
    "sample": "measure",
    "prepare": "protocol",
    "heated": "protocol",
    "Cooling": "free_cooling",
    "cooling": "free_cooling",
    "ratio_map": "sweep",
    "Snapshot": "snapshots",
    "snapshot_series": "snapshots",
    "Trajectory": "trajectory",
    "read_trajectory": "trajectory",
    "Fields": "fields",
    "fields_at": "fields",
    "gaussian": "coarse_graining",
    "heaviside": "coarse_graining",
    "lucy": "coarse_graining",
    "friction_law": "rheology",
    "Closure": "closure",
    "fit_closure": "closure_fit",
    "predict": "closure",
    "restitution_from_stresses": "stress_inversion",
    "RestitutionFit": "calibrate",
    "fit_restitution": "calibrate",
    "count_events": "dynamics",
    "friction_figure": "rheology_figures",
    "flow_figure": "flow_figures",
    "theory_errors": "theory_figures",
    "cluster_shares": "theory_figures",
    "ratio_against_timestep": "figures",
    "ratio_curves": "figures",
    "ratio_contours": "figures",
    "save_figures": "figures",
}
__all__ = [
    "Closure",
    "Cooling",
    "Fields",
    "Grains",
    "RestitutionFit",
    "Sample",
    "ShearFlow",
    "Snapshot",
    "State",
    "Status",
    "Tally",
    "Trajectory",
    "advance",
    "cluster_shares",
    "cooling",
    "count_events",
    "fields_at",
    "fit_closure",
    "fit_restitution",
    "flow_figure",
    "friction_figure",
    "friction_law",
    "gaussian",
    "heated",
    "heaviside",
    "lucy",
    "own_grains",
    "pack",
    "polydisperse",
    "predict",
    "prepare",
    "ratio_against_timestep",
    "ratio_contours",
    "ratio_curves",
    "ratio_map",
    "read_trajectory",
    "restitution_from_stresses",
    "sample",
    "save_figures",
    "snapshot_series",
    "theory_errors",
]


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'jaxgran' has no attribute {name!r}")
    return getattr(import_module(f"jaxgran.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_HOME]
