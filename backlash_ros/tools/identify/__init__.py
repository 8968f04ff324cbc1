"""`identify`: from a record of v and y to a checked parameter file."""
