"""The controller: structures that make v from y_m and the estimates, inverse (2.2), (2.3)."""
