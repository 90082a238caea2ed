"""Clusters: sets of grains joined by contacts."""

import numpy as np
import scipy  # loads its submodules on first use
from jaxtyping import Int


def cluster_labels(
    i: Int[np.ndarray, " pairs"], j: Int[np.ndarray, " pairs"], grains: int
) -> tuple[Int[np.ndarray, " grains"], Int[np.ndarray, " grains"]]:
    """The number of the cluster of each grain, and how many grains this cluster has.

    Examples:
      >>> cluster_labels(np.array([0, 3]), np.array([1, 0]), 4)
      (array([0, 0, 1, 0], dtype=int32), array([3, 3, 1, 3]))
    """
    graph = scipy.sparse.coo_array((np.ones(len(i), bool), (i, j)), shape=(grains, grains))
    labels = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    return labels, np.bincount(labels)[labels]
