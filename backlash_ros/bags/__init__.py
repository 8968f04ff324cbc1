"""Bags on disk: written so that a crash leaves them readable, read, repaired."""
