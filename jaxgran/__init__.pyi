"""The public names of jaxgran and where they live; they load when they are first used."""

from .analysis.fields import fields_at, grid
from .analysis.fit import fit_trajectory
from .analysis.jax_md_space import jax_md_space
from .cache.folder import use_cache
from .contact.problem import ContactNetwork, DelassusProblem
from .contact.projected_methods import BarzilaiBorwein, Jacobi, Nesterov, ProjectedMethod
from .contact.solve_contacts import solve_contacts
from .dynamics.advance import advance, count_events
from .dynamics.engine import Jax, Numba
from .dynamics.snapshot import Snapshot
from .dynamics.snapshots import snapshot_series
from .dynamics.tally import Tally
from .io.trajectory import read_trajectory, write_trajectory
from .maps.merge import merge_maps
from .maps.ratio_map import ratio_map
from .maps.results import open_map
from .model.checks import InputError
from .model.flow import ShearFlow
from .model.grains import Grains, own_grains, polydisperse
from .model.state import State
from .model.status import Status
from .page.explore import explore
from .plotting.against import averages_against_grains, ratio_against_timestep
from .plotting.factors import enskog_factors
from .plotting.flow import flow_figure
from .plotting.map_figures import save_figures
from .plotting.ratio import ratio_contours, ratio_curves
from .plotting.theory import cluster_shares, theory_errors
from .reference.law import constitutive_law
from .reference.validity import validity
from .sampling.heated import heated
from .sampling.packing import pack
from .sampling.sample import Sample
from .sampling.sampler import sample
from .sampling.steady_state import prepare

__version__: str
__all__ = [
    "BarzilaiBorwein",
    "ContactNetwork",
    "DelassusProblem",
    "Grains",
    "InputError",
    "Jacobi",
    "Jax",
    "Nesterov",
    "Numba",
    "ProjectedMethod",
    "Sample",
    "ShearFlow",
    "Snapshot",
    "State",
    "Status",
    "Tally",
    "advance",
    "averages_against_grains",
    "cluster_shares",
    "constitutive_law",
    "count_events",
    "enskog_factors",
    "explore",
    "fields_at",
    "fit_trajectory",
    "flow_figure",
    "grid",
    "heated",
    "jax_md_space",
    "merge_maps",
    "open_map",
    "own_grains",
    "pack",
    "polydisperse",
    "prepare",
    "ratio_against_timestep",
    "ratio_contours",
    "ratio_curves",
    "ratio_map",
    "read_trajectory",
    "sample",
    "save_figures",
    "snapshot_series",
    "solve_contacts",
    "theory_errors",
    "use_cache",
    "validity",
    "write_trajectory",
]
