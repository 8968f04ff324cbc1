"""What the recorder knows of each topic and of the run."""
