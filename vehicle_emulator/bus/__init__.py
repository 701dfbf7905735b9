"""The emulated CAN bus: a pure core, a hub process around it, and the python-can interface that joins it."""
