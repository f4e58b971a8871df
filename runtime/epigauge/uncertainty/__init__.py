"""Covariances of calibrated reconstructions, in any datum."""
