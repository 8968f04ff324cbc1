"""The linear regression within the fit: play output, error terms of G, their posterior."""
