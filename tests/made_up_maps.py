"""Made-up maps of a known excess of the force ratio."""

import numpy as np
import xarray as xr

FLAGS = "ok iteration_limit not_steady deep_overlap infeasible capacity nonfinite"
RATE = 8.0  # of the growth of the synthetic excess with 1 − α and with 2ν


def excess_of(restitution: np.ndarray, packing_fraction: np.ndarray) -> np.ndarray:
    """Return a smooth excess whose isolines are straight: 1 − α + 2ν = constant."""
    return 0.05 * np.exp(RATE * (1.0 - restitution + 2.0 * packing_fraction - 1.6))


def ratio_dataset(alphas: int = 5, nus: int = 6, relative_error: float = 0.05) -> xr.Dataset:
    """Return a synthetic map with the names and attributes of a measured one."""
    alpha, nu = np.linspace(0.1, 0.9, alphas), np.linspace(0.3, 0.8, nus)
    excess = excess_of(alpha[None, :], nu[:, None])
    dims = ("packing_fraction", "restitution")
    flags = {"flag_values": np.arange(7), "flag_meanings": FLAGS}
    return xr.Dataset(
        {
            "force_ratio": (dims, 1.0 + excess),
            "force_ratio_stderr": (dims, relative_error * excess),
            "status": (dims, np.zeros(excess.shape, int), flags),
        },
        coords={"packing_fraction": nu, "restitution": alpha},
        attrs={
            "format_version": 2,
            "timestep": 3e-4,
            "activation": "midpoint",
            "grains": 256,
            "seeds": 2,
            "strain": 5.0,
        },
    )


def with_timesteps(data: xr.Dataset, *timesteps: float) -> xr.Dataset:
    """Return a map of several time steps whose excess is that of a map at the first and twice as large at each next."""
    parts = [data.assign(force_ratio=1.0 + 2.0**k * (data.force_ratio - 1.0)) for k in range(len(timesteps))]
    several = xr.concat(parts, xr.Variable("timestep", list(timesteps)))
    return several.assign_attrs(data.attrs | {"timestep": list(timesteps)})


def with_grains(data: xr.Dataset, *grains: int, noise: float = 0.01) -> xr.Dataset:
    """Return a map of several numbers of grains, whose averages grow by different shares for a factor of four."""
    random, dims, parts = np.random.default_rng(0), data.force_ratio.dims, []
    growth = {"pressure": 0.10, "shear_stress": 0.08, "granular_temperature": 0.15, "force_ratio": 0.02}
    for size in grains:
        part = data
        for name, share in growth.items():
            value = data.force_ratio.values * (1.0 + share * np.log(size / grains[0]) / np.log(4.0))
            value = value * (1.0 + noise * random.normal(size=value.shape))
            part = part.assign({name: (dims, value), f"{name}_stderr": (dims, noise * value)})
        parts.append(part.assign(status=data.status.copy(deep=True)))
    several = xr.concat(parts, xr.Variable("grains", list(grains)))
    return several.assign_attrs(data.attrs | {"grains": list(grains)})


def with_variables(data: xr.DataTree, *names: str) -> xr.DataTree:
    """Return a map with only the named variables, as ``NAME`` or ``GROUP/NAME``."""
    kept = {node.path: [x for x in node.data_vars if f"{node.path}/{x}".strip("/") in names] for node in data.subtree}
    return xr.DataTree.from_dict({path: data[path].to_dataset()[chosen] for path, chosen in kept.items()})
