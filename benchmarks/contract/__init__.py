"""What `make accuracy` measures: rows of figures with their scatter, and the cases behind them."""
