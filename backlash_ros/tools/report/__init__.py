"""`report`: from a run to numbers, pictures and a page."""
