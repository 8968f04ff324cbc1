"""Logs of any kind: tables of text, Parquet, bags, results; what their columns are."""
