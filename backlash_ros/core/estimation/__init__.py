"""How m, c_r, c_l are learned from v and y: the protocol, the default law, and its baselines."""
