"""Identification: from observations to the parameters of a chain, with their covariance."""
