"""The loop that faults.py plays, in one process."""
