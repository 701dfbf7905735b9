"""The paper's controller, one module for each section: model, integrator, OCP, solver, planner, and the loop around them."""
