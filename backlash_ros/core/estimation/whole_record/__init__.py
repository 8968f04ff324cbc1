"""The same fit as one function of a record."""
