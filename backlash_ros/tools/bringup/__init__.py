"""`bringup`: plan, start, watch and stop the processes of a run."""
