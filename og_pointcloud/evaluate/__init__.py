"""Scores by the protocols of published tables, how sure they are, and sweeps of settings: error against run time."""
