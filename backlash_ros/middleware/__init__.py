"""Settings of the middleware."""
