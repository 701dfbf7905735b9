"""Local planner: the piece of path that the horizon covers, around what stands or moves on it. `planner` is where it starts."""
