"""Parts of the controller node: its first and last commands, what it publishes and serves."""
