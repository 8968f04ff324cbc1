"""Backlash (2.1), transfer function and state space of G(z), and the simulated plant (3.1)."""
