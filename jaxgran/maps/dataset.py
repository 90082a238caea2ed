"""The data of a ratio map: a DataTree of observables with errors on the grid, and all parameters of
the run.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
import xarray as xr

from jaxgran.dynamics.engine import select_engine
from jaxgran.maps.attributes import to_attrs
from jaxgran.maps.averages import Seeds, columns, samples_of
from jaxgran.maps.batches import points_of_part
from jaxgran.maps.conventions import CONVENTIONS, follow_conventions
from jaxgran.maps.own_observables import sums_by_name
from jaxgran.maps.provenance import made_with
from jaxgran.maps.replica import Replica, ReplicaId
from jaxgran.maps.rows import SUMS, sums_of
from jaxgran.maps.schema import FORMAT_VERSION, SOURCES_AND_TOTAL
from jaxgran.maps.settings import MapSettings
from jaxgran.maps.states import state_values
from jaxgran.maps.variables import COORDINATES, NOT_RUN, SCALARS, VARIABLES, Variable
from jaxgran.model.status import GIVEN_UP
from jaxgran.sampling.observe import dimensions_of
from jaxgran.sampling.sample import Sample, observed_estimates

_COMPRESSED = {"zlib": True, "shuffle": True, "complevel": 4}
_LONG = {"grain", "quantity"}  # dimensions of many numbers
_UNIFORM = "diameters uniform in 1 +- polydispersity, quantile midpoints; mass = diameter squared"
_GIVEN = "the diameters over their mean, as many grains of each; mass = diameter squared"


def map_dataset(
    settings: MapSettings,
    replicas: Iterable[Replica],
    run: Mapping[str, str | float | int],
    fewer_seeds: bool = False,
) -> xr.DataTree:
    """The data of the finished replicas; points without any are NaN with the status ``not_run`` or
    ``failed``.

    Its variables and coordinates are the rows of ``maps.variables``, and with the setting
    ``observe`` also NAME and NAME_stderr for what it returns; an array has the dimensions
    NAME_dim_0, NAME_dim_1, … behind those of a point. A point is (packing_fraction, restitution).
    Where the settings have several numbers of grains or time steps, the dimensions grains and
    timestep come before these.

    Args:
      settings: the map.
      replicas: in any order; those of other points and seeds are left out.
      run: further attributes to store: command, wall time, speed; with ``engine`` and ``solver``
        also what ran, where that is not what this process would take.
      fewer_seeds: whether points may have fewer seeds than others, and are measured then.
    """
    known = {replica.id: replica for replica in replicas}
    rows = [
        [known.get(ReplicaId(*point, seed)) for seed in settings.seed_numbers]
        for point in settings.points
    ]
    flows = settings.flows.values()
    samples = [samples_of(flow, seeds) for flow, seeds in zip(flows, rows, strict=True)]
    values = columns(settings, samples, rows, fewer_seeds)
    values |= {f"sums/{name}": x for name, x in _sums(rows).items()}
    if settings.snapshots:
        last = state_values(list(map(_first_state, rows)))
        values |= {f"states/{name}": x for name, x in last.items()}
    groups: dict[str, dict[str, xr.Variable]] = defaultdict(dict)
    for path, about in VARIABLES.items():
        group, _, name = path.rpartition("/")
        if path in values:
            groups[group or "/"][name] = _on_grid(settings, values[path], about)
        if about.has_error:
            of_error = about._replace(meaning=f"standard error of {about.meaning}", attrs={})
            error = _on_grid(settings, values[f"{path}_stderr"], of_error)
            groups[group or "/"][f"{name}_stderr"] = error
    groups["/"] |= _own_variables(settings, samples)
    coordinates = _coordinates(settings)
    tree = {
        group: follow_conventions(xr.Dataset(variables, coordinates.get(group)))
        for group, variables in groups.items()
    }
    about = run_attributes(settings)
    if "engine" not in run:
        engine = select_engine(settings.numerics)
        about |= {"engine": engine.name, "solver": engine.solver_in_use(settings.solver)}
    made = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {run.get('command', 'jaxgran.ratio_map')}"
    tree["/"].attrs.update({**about, "history": made, **run})  # in the form of CF
    return xr.DataTree.from_dict(tree)


def _on_grid(settings: MapSettings, values: np.ndarray, about: Variable) -> xr.Variable:
    """A variable of values (points, ...) in the order of ``settings.points``."""
    shape = [len(settings.axes[name]) for name in settings.dimensions]
    unit = {} if about.unit is None else {"units": about.unit}
    variable = xr.Variable(
        (*settings.dimensions, *about.dims),
        values.reshape(*shape, *values.shape[1:]),
        {"long_name": about.meaning, **unit, **about.attrs},
    )
    if _LONG & {*about.dims}:
        variable.encoding = dict(_COMPRESSED)
    return variable


def _sums(rows: Sequence[Seeds]) -> dict[str, np.ndarray]:
    """The columns of the group ``sums``, (points, seeds, ...); without a sample, no sums."""
    table = [[{} if x is None else sums_of(x) for x in seeds] for seeds in rows]
    shapes = {name: x.shape for seeds in table for row in seeds for name, x in row.items()}
    missing = {name: np.full(shapes.get(name, ()), np.nan) for name in SUMS}
    missing["status"] = np.asarray(NOT_RUN, np.int8)
    names = [name for name in SUMS if name in shapes or name not in ("area", "tally")]
    return {
        name: np.stack([[row.get(name, missing[name]) for row in seeds] for seeds in table])
        for name in names
    }


def _first_state(seeds: Seeds) -> Any:
    """The last state of the first good seed that has one."""
    good = (x.state for x in seeds if x is not None and x.status < GIVEN_UP)
    return next((state for state in good if state is not None), None)


def _own_variables(
    settings: MapSettings, samples: Sequence[Sequence[Sample]]
) -> dict[str, xr.Variable]:
    """The variables NAME and NAME_stderr in the root, for what ``observe`` returns."""
    if settings.observe is None:
        return {}
    variables = {}
    estimates = [observed_estimates(seeds) if seeds else ({}, {}) for seeds in samples]
    for name, sums in (sums_by_name(settings) or {}).items():
        missing, dims = np.full(sums.shape, np.nan), dimensions_of(name, sums.shape)
        value, error = (
            np.stack([np.asarray(x.get(name, missing), float) for x in column])
            for column in zip(*estimates, strict=True)
        )
        meaning, how = f"mean of {name} over all time steps", "realization: time: mean"
        about = Variable(meaning, None, dims, attrs={"cell_methods": how})
        variables[name] = _on_grid(settings, value, about)
        about = Variable(f"standard error of the mean of {name}", None, dims)
        variables[f"{name}_stderr"] = _on_grid(settings, error, about)
    return variables


def _coordinates(settings: MapSettings) -> dict[str, dict[str, xr.Variable]]:
    """The coordinates by the group that they belong to."""

    def along(name: str, values: Any) -> dict[str, xr.Variable]:
        return {name: xr.Variable(name, list(values), COORDINATES[name])}

    root: dict[str, xr.Variable] = {}
    for name in settings.dimensions:
        root |= along(name, settings.axes[name])
    for name, labels in (("error_source", SOURCES_AND_TOTAL), ("axis_a", "xy"), ("axis_b", "xy")):
        root |= along(name, labels)
    for name in settings.axes.keys() - {*settings.dimensions}:
        root[name] = xr.Variable((), settings.axes[name][0], COORDINATES[name])
    if settings.grains_by_point is not None:
        del root["grains"]
        about = Variable(COORDINATES["point_grains"]["long_name"])
        root["point_grains"] = _on_grid(settings, np.array(settings.grains_by_point), about)
    return {
        "/": root,
        "diagnostics": along("observable", SCALARS),
        "sums": along("seed", range(settings.seeds)),
    }


def run_attributes(settings: MapSettings) -> dict[str, Any]:
    """All parameters of the run, in types that NetCDF can store.

    ==========================  ====================================================================
    attribute                   meaning
    ==========================  ====================================================================
    title, Conventions          what the file is, and the version of the CF conventions
    format_version              of the groups and names in the file; files of another one are
                                refused
    restitution, …, first_seed  the settings by their names in ``ratio_map``, see ``to_attrs``
    engine, solver              what ran; numbers of grains, preparation and sample may have
                                different ones on a GPU
    engine_requested, solver_requested  what was asked for
    observe                     names of the user's observables, and a hash of what their function
                                computes
    equilibrate                 strain before the sample, or "until steady"
    timestep_unit               of the time step
    strain_meaning              of the strain
    shear_rate                  γ̇
    polydispersity or           of the grains
    diameters,
    size_distribution
    part, part_points           share of the points that the file has, and their numbers from 0, if
                                it is not all
    tolerance, max_steps        of a contact solve
    solver_parameters           all fields of the solver, in JSON
    precision, device,          what it was computed with; the commit is empty outside a repository
    platform, python, commit
    version_PACKAGE             version of jaxgran and of packages that the numbers depend on
    code_digest                 hash of the sources of jaxgran
    random_bits                 generator of random numbers
    history, command            when and by what command the map was made
    automatic_choice            what was chosen by ``auto``, in words
    workers, resumed_replicas   number of threads, and of replicas that an earlier process left
    wall_time_seconds,          of the last process
    replica_steps_per_second
    ==========================  ====================================================================
    """
    return {
        "title": "Ratio of the mean contact force to that of binary collisions in simple shear of "
        "hard discs",
        "Conventions": CONVENTIONS,
        "format_version": FORMAT_VERSION,
        **to_attrs(settings),
        "timestep_unit": "1 / shear rate",
        "strain_meaning": "sampled strain of each seed; where none is given, see sums/strain",
        "shear_rate": settings.flows[settings.points[0]].shear_rate,
        "size_distribution": _UNIFORM if settings.diameters is None else _GIVEN,
        **({} if settings.part is None else {"part_points": points_of_part(settings)}),
        **made_with(),
    }
