"""What the fit of a record tells, how surely, and what else it may be."""
