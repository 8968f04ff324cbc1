"""Gears made of physics: their runs in one process."""
