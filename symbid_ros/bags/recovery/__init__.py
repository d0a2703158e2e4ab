"""Recovery of damaged bags: what can be trusted is copied into a new bag."""
