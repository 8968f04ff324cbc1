"""`identify`: make a checked parameter file from a record of v and y."""
