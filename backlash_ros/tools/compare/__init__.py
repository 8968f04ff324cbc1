"""`compare`: laws and structures side by side."""
