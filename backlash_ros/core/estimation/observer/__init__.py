"""What happens at every sample: u and the state of G, outliers, which command acted."""
