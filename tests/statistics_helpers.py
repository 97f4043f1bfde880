"""The one way in which a statistical test compares."""

import numpy as np


def assert_within_sigma(estimate, expected, stderr, n_sigma=5.0):
    """Fail when the estimate is more than ``n_sigma`` standard errors from truth."""
    pull = (np.asarray(estimate) - expected) / stderr
    assert np.all(np.abs(pull) < n_sigma), f"pull {pull} exceeds {n_sigma} sigma"
