"""The cars that can be emulated, behind one interface: a multibody car, the paper's bicycle, an FMU, a published model."""
