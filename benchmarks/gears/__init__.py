"""Gears made of physics: their runs in one process and in real ones, and the map."""
