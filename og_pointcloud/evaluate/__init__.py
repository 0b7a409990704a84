"""Scores by the protocols of published tables, their intervals, and sweeps of settings: error against run time."""
