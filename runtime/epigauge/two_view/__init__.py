"""Two views: from point matches to the maximum-likelihood fundamental matrix."""
