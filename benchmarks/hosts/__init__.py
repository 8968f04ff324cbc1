"""Two hosts on this machine, and a cable between them."""
