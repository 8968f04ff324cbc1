"""Judgement of a fit: what it tells, how certain that is, and what else may explain the record."""
