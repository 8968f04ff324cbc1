"""The default law: one fit of all unknowns to a record, and one comparison of its explanations."""
