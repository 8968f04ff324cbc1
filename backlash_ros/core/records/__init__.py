"""Turn the rows of any log, with stamps of any kind, into v and y on one uniform grid of time."""
