"""Read logs of any kind, text tables, Parquet, bags and results, and recognise their columns."""
