"""Standard errors follow from how gradients differ between clusters of rows."""

import numpy as np
import pytest

from gaponet.sysid.standard_errors import MIN_CLUSTERS, cluster_scatter


def test_the_scatter_of_clusters_has_the_jackknifes_correction():
    """Half of the clusters at 1 and half at 3 deviate by 1; n − 1 of n are left beside one fitted
    parameter.
    """
    window = np.arange(MIN_CLUSTERS)
    slope = np.where(window % 2 == 0, 1.0, 3.0)
    gradient = slope[None, :, None]  # (1 joint, rows, 1 parameter)

    scatter = cluster_scatter(gradient, window)

    corrected = MIN_CLUSTERS * (MIN_CLUSTERS / (MIN_CLUSTERS - 1)) ** 2
    assert scatter.item() == pytest.approx(corrected)
