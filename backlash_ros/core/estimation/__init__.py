"""How m, c_r, c_l are learned from v and y: the default law."""
