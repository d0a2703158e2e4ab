"""What an estimate leaves unexplained, and the likely cause."""
