"""The G of low order that a fit speaks for: what a structure can be designed for."""
