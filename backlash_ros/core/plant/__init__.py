"""B(.) and G(z): (2.1), transfer function and state space, and a plant (3.1) made of them."""
