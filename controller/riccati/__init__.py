"""Solver `riccati`: SQP in C that uses the structure of the optimal control problem, on soft constraints and with bounded work."""
