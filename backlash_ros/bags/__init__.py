"""Bags on disk, whole or damaged: their parts, their remains, their repair."""
