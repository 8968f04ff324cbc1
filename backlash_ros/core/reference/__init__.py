"""y_m(t), from a formula or from a file."""
