"""Forces that an identified robot predicts, and how well, with and without a known truth."""
