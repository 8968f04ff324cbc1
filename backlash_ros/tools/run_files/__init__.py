"""Files of a run, and runs read back from bags."""
