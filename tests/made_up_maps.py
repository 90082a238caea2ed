"""Made-up maps of a known excess of the force ratio."""

import numpy as np
import xarray as xr

from jaxgran.model.choices import HALF_INTERVAL
from jaxgran.plotting.factors import FACTORS, PREFIX

FLAGS = "ok iteration_limit not_steady deep_overlap infeasible capacity nonfinite"
RATE = 8.0  # of the growth of the synthetic excess with 1 − α and with 2ν
DIMS = ("packing_fraction", "restitution")
STDERR = 0.02  # of every stress in a map of the theory, relative
GROWTH = 1.07  # of a stress from the grains of such a map to a large system


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
            "format_version": 5,
            "timestep": 3e-4,
            "activation": "midpoint",
            "grains": 256,
            "seeds": 2,
            "strain": 5.0,
        },
    )


def with_timesteps(data: xr.Dataset, *timesteps: float) -> xr.Dataset:
    """Return a map of several time steps whose excess is twice as large at each next."""
    parts = [
        data.assign(force_ratio=1.0 + 2.0**k * (data.force_ratio - 1.0))
        for k in range(len(timesteps))
    ]
    several = xr.concat(parts, xr.Variable("timestep", list(timesteps)))
    return several.assign_attrs(data.attrs | {"timestep": list(timesteps)})


def with_grains(data: xr.Dataset, *grains: int, noise: float = 0.01) -> xr.Dataset:
    """Return a map of several numbers of grains; averages grow by shares for a factor of four."""
    random, dims, parts = np.random.default_rng(0), data.force_ratio.dims, []
    growth = {
        "pressure": 0.10,
        "shear_stress": 0.08,
        "granular_temperature": 0.15,
        "force_ratio": 0.02,
    }
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
    kept = {
        node.path: [x for x in node.data_vars if f"{node.path}/{x}".strip("/") in names]
        for node in data.subtree
    }
    return xr.DataTree.from_dict(
        {path: data[path].to_dataset()[chosen] for path, chosen in kept.items()}
    )


def assumption_of(x: np.ndarray, nu: np.ndarray) -> np.ndarray:
    """Return the synthetic ln(binary/measured), linear in x = 1 − α and ν."""
    return -0.5 * x - 0.8 * (nu - 0.3)


def closure_of(x: np.ndarray, nu: np.ndarray) -> np.ndarray:
    """Return the synthetic ln(theory/binary), of both signs."""
    return 1.5 * (x - 0.5) + 0.6 * (nu - 0.547)


def factor_of(k: int, x: np.ndarray, nu: np.ndarray) -> np.ndarray:
    """Return the logarithm of synthetic factor k of a stress; the first is within its error."""
    return 0.5 * STDERR * (x - x) if k == 0 else (-1.0) ** k * (0.4 * k * x + 0.5 * (nu - 0.55))


def temperature_factor_of(x: np.ndarray, nu: np.ndarray) -> np.ndarray:
    """Return the logarithm of the synthetic factor of the temperature."""
    return 0.3 * x + 0.2 * nu


def share_of(x: np.ndarray, nu: np.ndarray) -> np.ndarray:
    return 0.08 + 0.6 * x + 0.6 * (nu - 0.4)


def theory_dataset(alphas: int = 5, nus: int = 6) -> xr.Dataset:
    """Return a synthetic map with stresses, predictions of a theory, and shares of clusters."""
    data = ratio_dataset(alphas, nus)
    x, nu = 1.0 - data.restitution.values[None, :], data.packing_fraction.values[:, None]
    tensors = {
        f"stresses/{part}_stress": np.zeros((*data.force_ratio.shape, 2, 2))
        for part in ("kinetic", "binary")
    }
    added = {}
    for scale, name in ((3.0, "pressure"), (1.0, "shear_stress")):
        measured = scale * np.exp(2.0 * nu) * np.ones_like(x)
        binary = measured * np.exp(assumption_of(x, nu))
        added |= {name: (DIMS, measured), f"{name}_stderr": (DIMS, STDERR * measured)}
        large = f"{name}_large_system"
        half = HALF_INTERVAL * STDERR * GROWTH * measured[..., None]
        added |= {
            large: (DIMS, GROWTH * measured),
            f"{large}_ci95": ((*DIMS, "error_source"), half),
        }
        for tensor, part in zip(
            tensors.values(), (0.3 * measured, binary - 0.3 * measured), strict=True
        ):
            for a, b in ((0, 0), (1, 1)) if name == "pressure" else ((0, 1), (1, 0)):
                tensor[..., a, b] = part if a == b else -part
        added[f"theory/{name}"] = (DIMS, GROWTH * binary * np.exp(closure_of(x, nu)))
    theory = added["theory/pressure"][1]
    temperature = np.full(theory.shape, 1.5)
    enskog = 0.85 * theory * np.exp(temperature_factor_of(x, nu))
    added |= {
        "granular_temperature": (DIMS, temperature),
        "theory/granular_temperature": (DIMS, 0.5 * temperature * theory / added["pressure"][1]),
        "theory/enskog_pressure": (DIMS, enskog),  # the theory's is 0.85 of its pressure
        "theory/enskog_pressure_stderr": (DIMS, STDERR * enskog),
    }
    for k, factor in enumerate(FACTORS):
        value = np.exp(factor_of(k, x, nu)) * np.ones(data.force_ratio.shape)
        name = f"{PREFIX}{factor}"
        added |= {name: (DIMS, value), f"{name}_stderr": (DIMS, STDERR * value)}
    added |= {name: ((*DIMS, "axis_a", "axis_b"), tensor) for name, tensor in tensors.items()}
    added |= {
        f"{name}_stderr": ((*DIMS, "axis_a", "axis_b"), STDERR * np.abs(x))
        for name, x in tensors.items()
    }
    ratio = np.ones((*data.force_ratio.shape, 2, 2))
    added |= {"stress_ratio": ((*DIMS, "axis_a", "axis_b"), ratio)}
    added |= {"stress_ratio_stderr": ((*DIMS, "axis_a", "axis_b"), STDERR * ratio)}
    for name in ("stresses/cluster_pressure_share", "stresses/cluster_shear_share"):
        added |= {
            name: (DIMS, share_of(x, nu)),
            f"{name}_stderr": (DIMS, np.full((nus, alphas), 0.03)),
        }
    return data.assign(added).assign_coords(error_source=["total"])
