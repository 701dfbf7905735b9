"""The bench: everything around a run. It may import every other package; none imports it."""
