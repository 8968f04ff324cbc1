"""The fit, and the G of low order, by the intervals that rounded readings tell."""
