"""The symbid command."""
