"""Messages into new bags, and what a crash or a full disk leaves of them."""
