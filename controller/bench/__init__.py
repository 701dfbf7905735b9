"""Bench of the solvers: the same recorded problems for all of them, side by side. `run` is where it starts."""
