"""A car of fifteen degrees of freedom: body 6, suspension 4, wheels 4, steering 1; equations in CasADi, compiled to C."""
