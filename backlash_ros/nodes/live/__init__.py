"""`live`: running controllers on a page in the browser."""
