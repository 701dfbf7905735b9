"""The solver's library for others: compiled for a target, or written as a directory of C with its own checker."""
