"""`simulate`: one run, many seeds, sweeps, in one process."""
